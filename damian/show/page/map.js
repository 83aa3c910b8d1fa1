/** The view from above. */

import { fitted } from "page/canvas";
import { Frame, length, roundLength } from "page/geography";
import { Ground } from "page/ground";
import { label } from "page/marks";
import { drawMarks } from "page/overlay";
import { faint } from "page/theme";

export class MapView {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {import("page/episode").Episode} episode
   * @param {number} likely see Ground
   * @param {import("page/zoom").Zoom} zoom
   * @param {boolean} believed whether it shows only what the server believes
   */
  constructor(canvas, episode, likely, zoom, believed = false) {
    Object.assign(this, { canvas, episode, zoom, believed });
    this.ground = new Ground(episode, likely, believed ? episode.heard : episode.position);
    this.places = new Map();
  }

  /** Draw what there is at a time; the canvas has the size [px] that its element has. */
  draw(now, layers, theme) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    const context = fitted(this.canvas, width, height);
    this.canvas.classList.toggle("near", this.zoom.factor > 1);
    const limits = this.zoom.limits(this.episode.limits);
    const pixels = new Frame(limits, this.canvas.width, this.canvas.height);
    this.ground.paint(pixels, now.step, layers, theme);
    context.drawImage(this.ground.canvas, 0, 0, width, height);
    this.frame = new Frame(limits, width, height);
    if (layers.has(this.believed ? "believed" : "truth")) this.#footprints(context, now, theme);
    if (layers.has("truth")) this.#trails(context, now, theme);
    const pixel = (place) => this.frame.pixel(place);
    const { episode, places } = this;
    this.shown = drawMarks({ context, episode, now, layers, theme, pixel, darts: true, rise: 0, places });
    this.#scaleBar(context, theme);
  }

  /** Place [m] of a pixel of the canvas. */
  place(x, y) {
    return this.frame?.place(x, y);
  }

  #footprints(context, now, theme) {
    const { episode, frame } = this;
    for (let uav = 0; uav < episode.nAgents; uav++) {
      const colour = theme.mark(uav, episode.late(uav, now));
      const spotted = episode.spotted[now.step][uav] && !this.believed;
      const at = this.believed ? episode.believed[now.step][uav] : episode.place(uav, now);
      context.beginPath();
      context.arc(...frame.pixel(at), episode.radius * frame.scale, 0, 2 * Math.PI);
      context.fillStyle = faint(colour, spotted ? 0.26 : 0.07);
      context.strokeStyle = faint(colour, spotted ? 1 : theme.tells(uav) ? 0.6 : 0);
      context.lineWidth = spotted ? 2 : 0.8;
      context.fill();
      context.stroke();
    }
  }

  #trails(context, now, theme) {
    const { episode, frame } = this;
    context.lineWidth = 2;
    context.lineCap = "round";
    for (const uav of episode.ids.keys()) {
      if (!theme.tells(uav)) continue;
      const path = episode.trail(uav, now).map((place) => frame.pixel(place));
      path.slice(1).forEach((to, i) => {
        context.strokeStyle = faint(theme.uav(uav), 0.1 + (0.6 * (i + 1)) / path.length);
        context.beginPath();
        context.moveTo(...path[i]);
        context.lineTo(...to);
        context.stroke();
      });
    }
  }

  #scaleBar(context, theme) {
    const metres = roundLength((0.3 * this.frame.width) / this.frame.scale);
    const [left, bottom, width] = [12, this.frame.height - 12, metres * this.frame.scale];
    context.strokeStyle = theme.muted;
    context.lineWidth = 1.5;
    context.lineCap = "butt";
    context.beginPath();
    context.moveTo(left, bottom - 5);
    context.lineTo(left, bottom);
    context.lineTo(left + width, bottom);
    context.lineTo(left + width, bottom - 5);
    context.stroke();
    label(context, [left + 6, bottom - 9], length(metres), theme.muted, theme);
  }
}
