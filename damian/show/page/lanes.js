/** Messages over time: a row for each UAV. Dots arrive at once, bars are late, crosses are lost. */

import { listenToDrag } from "page/brush";
import { fitted } from "page/canvas";
import { GUTTER, MARGIN } from "page/charts";
import * as marks from "page/marks";
import { faint } from "page/theme";

/** Height of a row, and of one of many [px]. */
const [ROW, LOW_ROW] = [20, 15];
/** Largest number of steps whose messages are drawn one by one, and width of the spans of more [px]. */
const [MOST, SPAN] = [200, 5];
/** Opacity of what is to come. */
const PALE = 0.25;
const MARKS = "Messages: dots arrive at once, bars are late, crosses are lost.";
const SHARES = "Messages: the stronger the colour, the more are late; the higher the bar, the more are lost.";

export class Lanes {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {HTMLElement} note says what the rows show
   * @param {import("page/episode").Episode} episode
   * @param {import("page/player").Player} player
   */
  constructor(canvas, note, episode, player) {
    Object.assign(this, { canvas, note, episode, player });
    this.picture = document.createElement("canvas");
    this.row = episode.nAgents <= 8 ? ROW : LOW_ROW;
    canvas.style.height = `${this.row * episode.nAgents + 8}px`;
    const timeAt = (event) => {
      const [from, to] = player.shown;
      const share = (event.offsetX - GUTTER) / (canvas.clientWidth - GUTTER - MARGIN);
      return from + Math.min(Math.max(share, 0), 1) * (to - from);
    };
    listenToDrag(canvas, timeAt, player);
  }

  /** Draw all messages; what is to come after a time is pale. */
  draw(now, theme) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width) return;
    const [from, to] = this.player.shown;
    const x = (time) => GUTTER + ((time - from) * (width - GUTTER - MARGIN)) / (to - from);
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
    if (this.player.chosen) {
      const [left, right] = this.player.chosen.map(x);
      context.fillStyle = faint(theme.ink, 0.12);
      context.fillRect(left, 0, right - left, height);
    }
  }

  /** Paint all messages into a picture, again only in another size, other colours or another part of the time. */
  #paint(width, height, x, y, theme) {
    const [from, to] = this.player.shown;
    const key = [width, height, devicePixelRatio, theme.dark, theme.chosen, from, to].join();
    if (key === this.painted) return;
    this.painted = key;
    const many = to - from > MOST * this.episode.dt;
    this.note.textContent = many ? SHARES : MARKS;
    const context = fitted(this.picture, width, height);
    context.save();
    context.beginPath();
    context.rect(GUTTER - 5, 0, width - GUTTER - MARGIN + 10, height);
    context.clip();
    if (many) this.#shares(context, width - GUTTER - MARGIN, x, y, theme);
    else {
      const seen = this.episode.messages.filter(
        (each) => each.sent <= to && !(each.arrives < from && each.sent < from),
      );
      for (const message of seen) this.#message(context, message, x, y, theme);
    }
    context.restore();
  }

  /** The shares of messages that are late, and that are lost, in spans of the time. */
  #shares(context, width, x, y, theme) {
    const { nAgents, messages } = this.episode;
    const spans = Math.ceil(width / SPAN);
    const [sent, late, lost] = [0, 1, 2].map(() => new Uint32Array(nAgents * spans));
    for (const message of messages) {
      const span = Math.floor((x(message.sent) - GUTTER) / SPAN);
      if (span < 0 || span >= spans) continue;
      const at = message.uav * spans + span;
      sent[at]++;
      if (message.lost) lost[at]++;
      else if (message.arrives > message.sent) late[at]++;
    }
    const height = this.row - 2;
    for (let at = 0; at < sent.length; at++) {
      if (!sent[at]) continue;
      const uav = Math.floor(at / spans);
      const [left, bottom] = [GUTTER + (at % spans) * SPAN, y(uav) + height / 2];
      context.fillStyle = faint(theme.uav(uav), 0.1 + (0.9 * late[at]) / sent[at]);
      context.fillRect(left, bottom - height, SPAN, height);
      const black = (height * lost[at]) / sent[at];
      context.fillStyle = theme.lost(uav);
      context.fillRect(left, bottom - black, SPAN, black);
    }
  }

  #message(context, { uav, sent, arrives, lost }, x, y, theme) {
    const [colour, height] = [theme.uav(uav), y(uav)];
    const size = Math.min(this.row / 4.5, 4);
    if (lost) {
      marks.cross(context, [x(sent), height], theme.lost(uav), 0.8 * size);
    } else if (arrives === sent) {
      marks.dot(context, [x(sent), height], size / 2, colour);
    } else {
      context.fillStyle = faint(colour, 0.6);
      const end = x(Math.min(arrives, this.player.end));
      context.fillRect(x(sent), height - 0.375 * size, end - x(sent), Math.max(0.75 * size, 1));
      if (arrives <= this.episode.end) marks.arrow(context, [x(arrives), height], size, colour);
    }
  }

  #names(context, y, theme) {
    context.font = "11px system-ui, sans-serif";
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (let uav = 0; uav < this.episode.nAgents; uav++) {
      context.fillStyle = theme.text(uav);
      context.fillText(this.episode.names[uav], GUTTER - 8, y(uav), GUTTER - 10);
    }
    context.textAlign = "left";
  }
}
