/** Messages over time: a row for each UAV. Dots arrive at once, bars are late, crosses are lost. */

import { fitted } from "page/canvas";
import { GUTTER, MARGIN } from "page/charts";
import * as marks from "page/marks";
import { faint } from "page/theme";

/** Height of a row, at most, and of all rows together, at most [px]. */
const [ROW, HIGHEST] = [20, 168];
/** Opacity of what is to come. */
const PALE = 0.25;

export class Lanes {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {import("page/episode").Episode} episode
   * @param {import("page/player").Player} player
   */
  constructor(canvas, episode, player) {
    Object.assign(this, { canvas, episode, player });
    this.picture = document.createElement("canvas");
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
    const span = (width - GUTTER - MARGIN) / Math.max(this.player.end, this.episode.dt);
    const x = (time) => GUTTER + Math.min(time, this.player.end) * span;
    const y = (uav) => 4 + (uav + 0.5) * this.row;
    this.#paint(width, height, x, y, theme);
    const context = fitted(this.canvas, width, height);
    context.globalAlpha = PALE;
    context.drawImage(this.picture, 0, 0, width, height);
    context.globalAlpha = 1;
    context.save();
    context.beginPath();
    context.rect(GUTTER - 6, 0, x(now.time) - GUTTER + 6 + (now.ended ? MARGIN : 2), height);
    context.clip();
    context.clearRect(0, 0, width, height);
    context.drawImage(this.picture, 0, 0, width, height);
    context.restore();
    this.#names(context, y, theme);
    context.fillStyle = theme.ink;
    context.fillRect(x(now.time) - 0.5, 0, 1, height);
  }

  /** Paint all messages into a picture, again only in another size or other colours. */
  #paint(width, height, x, y, theme) {
    const key = [width, height, devicePixelRatio, theme.dark].join();
    if (key === this.painted) return;
    this.painted = key;
    const context = fitted(this.picture, width, height);
    for (const message of this.episode.messages) this.#message(context, message, x, y, theme);
  }

  #message(context, { uav, sent, arrives, lost }, x, y, theme) {
    const [colour, height] = [theme.uav(uav), y(uav)];
    const size = Math.min(this.row / 4.5, 4);
    if (lost) {
      marks.cross(context, [x(sent), height], theme.ink, 0.8 * size);
    } else if (arrives === sent) {
      marks.dot(context, [x(sent), height], size / 2, colour);
    } else {
      context.fillStyle = faint(colour, 0.6);
      context.fillRect(x(sent), height - 0.375 * size, x(arrives) - x(sent), Math.max(0.75 * size, 1));
      if (arrives <= this.player.end) marks.arrow(context, [x(arrives), height], size, colour);
    }
  }

  #names(context, y, theme) {
    if (this.row < 11) return;
    context.font = "11px system-ui, sans-serif";
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (let uav = 0; uav < this.episode.nAgents; uav++) {
      context.fillStyle = theme.uav(uav);
      context.fillText(this.episode.names[uav], GUTTER - 8, y(uav), GUTTER - 10);
    }
    context.textAlign = "left";
  }
}
