/** Messages over time, in the colours of how late they are: a row for each UAV; of many a histogram, and a row
 * for the chosen one. */

import { listenToDrag } from "page/brush";
import { fitted } from "page/canvas";
import { GUTTER, MARGIN } from "page/charts";
import { plain } from "page/marks";
import { faint } from "page/theme";

/** Height of a row, of one of many, and of the histogram of more than MANY UAVs [px]. */
const [ROW, LOW_ROW, HISTOGRAM] = [20, 15, 110];
const MANY = 20;
/** Least width of a span whose messages have one colour [px]. */
const SPAN = 4;
/** Kinds of lateness in a histogram. */
const KINDS = 9;
/** Opacity of what is to come. */
const PALE = 0.25;

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
    this.many = episode.nAgents > MANY;
    this.row = episode.nAgents <= 8 || this.many ? ROW : LOW_ROW;
    canvas.style.height = `${8 + (this.many ? HISTOGRAM + ROW : this.row * episode.nAgents)}px`;
    const timeAt = (event) => {
      const [from, to] = player.shown;
      const share = (event.offsetX - GUTTER) / (canvas.clientWidth - GUTTER - MARGIN);
      return from + Math.min(Math.max(share, 0), 1) * (to - from);
    };
    listenToDrag(canvas, timeAt, player);
  }

  /** Upper border of the row of a UAV [px]. */
  top(uav) {
    return 4 + (this.many ? HISTOGRAM : uav * this.row);
  }

  /** Draw all messages; what is to come after a time is pale. */
  draw(now, theme) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width) return;
    const [from, to] = this.player.shown;
    const x = (time) => GUTTER + ((time - from) * (width - GUTTER - MARGIN)) / (to - from);
    const y = (uav) => this.top(uav) + this.row / 2;
    this.#paint(width, height, x, y, theme);
    const context = fitted(this.canvas, width, height);
    context.globalAlpha = PALE;
    context.drawImage(this.picture, 0, 0, width, height);
    context.globalAlpha = 1;
    context.save();
    context.beginPath();
    context.rect(GUTTER - 6, 0, x(now.time) - GUTTER + 6 + (now.ended ? MARGIN : 0.5), height);
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
    const context = fitted(this.picture, width, height);
    context.save();
    context.beginPath();
    context.rect(GUTTER - 5, 0, width - GUTTER - MARGIN + 10, height);
    context.clip();
    const span = Math.max(x(from + this.episode.dt) - GUTTER, SPAN);
    const spans = new Map();
    for (const message of this.episode.messages) {
      const at = Math.floor((x(message.sent - this.episode.dt / 2) - GUTTER) / span);
      if (at < 0 || at * span > width) continue;
      const rows = spans.get(at) ?? spans.set(at, new Map()).get(at);
      const late = message.lost ? -1 : (message.arrives - message.sent) / this.episode.longest;
      rows.set(message.uav, [...(rows.get(message.uav) ?? []), late]);
    }
    for (const [at, rows] of spans) {
      const left = GUTTER + at * span;
      if (this.many) this.#stack(context, left, span, [...rows.values()].flat(), theme);
      for (const [uav, late] of rows)
        if (!this.many || uav === theme.chosen) this.#cell(context, left, span, this.top(uav), late, theme);
    }
    context.restore();
    this.#explain(theme);
  }

  /** The messages of a UAV in a span: their mean lateness, and from below the share of lost ones. */
  #cell(context, left, span, top, late, theme) {
    const [heard, height] = [late.filter((each) => each >= 0), this.row - 2];
    context.fillStyle = theme.lateness(heard.reduce((sum, each) => sum + each, 0) / (heard.length || 1));
    context.fillRect(left, top + 1, span, height);
    const black = height * (1 - heard.length / late.length);
    context.fillStyle = theme.ink;
    context.fillRect(left, top + 1 + height - black, span, black);
  }

  /** The shares of the messages in a span by lateness, the latest above, lost ones on top. */
  #stack(context, left, span, late, theme) {
    const counts = new Array(KINDS + 1).fill(0);
    for (const each of late) counts[each < 0 ? KINDS : Math.min(Math.round(each * (KINDS - 1)), KINDS - 1)]++;
    let bottom = 4 + HISTOGRAM;
    counts.forEach((count, kind) => {
      const height = ((HISTOGRAM - 8) * count) / late.length;
      context.fillStyle = kind === KINDS ? theme.ink : theme.lateness(kind / (KINDS - 1));
      context.fillRect(left, (bottom -= height), span, height);
    });
  }

  /** Say what the colours mean. */
  #explain(theme) {
    const bar = document.createElement("span");
    bar.className = "lateness";
    bar.style.background = `linear-gradient(to right, ${theme.lates.join(", ")})`;
    const what = this.many ? "Messages of all UAVs, by lateness" : "Messages, by lateness";
    const lost = this.episode.messages.some((each) => each.lost) ? "; black: lost" : "";
    this.note.replaceChildren(`${what}: 0 `, bar, ` ${plain(this.episode.longest)} s${lost}`);
  }

  #names(context, y, theme) {
    context.font = "11px system-ui, sans-serif";
    context.textAlign = "right";
    context.textBaseline = "middle";
    const named = this.many ? [theme.chosen].filter((uav) => uav !== null) : this.episode.ids.keys();
    if (this.many) {
      context.fillStyle = theme.muted;
      context.fillText("all UAVs", GUTTER - 8, 4 + HISTOGRAM / 2, GUTTER - 10);
    }
    for (const uav of named) {
      context.fillStyle = theme.text(uav);
      context.fillText(this.episode.names[uav], GUTTER - 8, y(uav), GUTTER - 10);
    }
    context.textAlign = "left";
  }
}
