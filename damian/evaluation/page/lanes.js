/** Messages over time: a row for each UAV. Dots arrive at once, bars are late, crosses are lost. */

import { GUTTER, MARGIN } from "page/charts";
import * as marks from "page/marks";
import { faint } from "page/theme";

/** Height of a row, at most, and of all rows together, at most [px]. */
const [ROW, HIGHEST] = [20, 168];

export class Lanes {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {import("page/episode").Episode} episode
   * @param {import("page/player").Player} player
   */
  constructor(canvas, episode, player) {
    Object.assign(this, { canvas, episode, player });
    this.row = Math.min(ROW, HIGHEST / episode.nAgents);
    canvas.style.height = `${Math.ceil(this.row * episode.nAgents) + 8}px`;
    canvas.addEventListener("click", (event) => {
      const share = (event.offsetX - GUTTER) / (canvas.clientWidth - GUTTER - MARGIN);
      player.seek(share * player.end);
    });
  }

  /** Draw all messages; what is to come after a time is pale. */
  draw(now, theme) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width) return;
    this.canvas.width = Math.round(width * devicePixelRatio);
    this.canvas.height = Math.round(height * devicePixelRatio);
    const context = this.canvas.getContext("2d");
    context.scale(devicePixelRatio, devicePixelRatio);
    const span = (width - GUTTER - MARGIN) / Math.max(this.player.end, this.episode.dt);
    const x = (time) => GUTTER + Math.min(time, this.player.end) * span;
    const y = (uav) => 4 + (uav + 0.5) * this.row;
    this.#names(context, y, theme);
    for (const message of this.episode.messages) {
      const bright = message.sent <= now.time;
      context.globalAlpha = bright ? 1 : 0.22;
      this.#message(context, message, now, x, y, theme);
    }
    context.globalAlpha = 1;
    context.strokeStyle = theme.ink;
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(x(now.time), 0);
    context.lineTo(x(now.time), height);
    context.stroke();
  }

  /** A message; of one under way, the part of its way that is still to come is pale. */
  #message(context, { uav, sent, arrives, lost }, now, x, y, theme) {
    const [colour, height] = [theme.uav(uav), y(uav)];
    const size = Math.min(this.row / 4.5, 4);
    if (lost) return marks.cross(context, [x(sent), height], theme.ink, 0.8 * size);
    if (arrives === sent) return marks.dot(context, [x(sent), height], size / 2, colour);
    const reached = Math.min(Math.max(now.time, sent), arrives);
    context.lineWidth = Math.max(0.75 * size, 1);
    context.lineCap = "butt";
    for (const [from, to, opacity] of [[sent, reached, 0.75], [reached, arrives, 0.25]]) {
      context.strokeStyle = faint(colour, opacity);
      context.beginPath();
      context.moveTo(x(from), height);
      context.lineTo(x(to), height);
      context.stroke();
    }
    if (arrives > this.player.end) return undefined;
    context.fillStyle = faint(colour, reached >= arrives ? 1 : 0.4);
    context.beginPath();
    context.moveTo(x(arrives) + size, height);
    context.lineTo(x(arrives) - size, height - size);
    context.lineTo(x(arrives) - size, height + size);
    return context.fill();
  }

  #names(context, y, theme) {
    if (this.row < 11) return;
    context.font = "11px system-ui, sans-serif";
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (let uav = 0; uav < this.episode.nAgents; uav++) {
      context.fillStyle = theme.uav(uav);
      context.fillText(`UAV ${uav}`, GUTTER - 8, y(uav));
    }
    context.textAlign = "left";
  }
}
