/** What lies on the ground: the region, its landing points, what is covered, the belief about the source. */

import { faint } from "page/theme";

/** Colour of a cell in which the source surely is; others are fainter, on a logarithmic scale. */
export const OPACITY = 0.75;
/** Opacity of the ground that was ever covered, and of the latest footprints; how much of these fades in a step. */
const [COVERED, FADE] = [[0.22, 0.4], 0.22];
/** Mark of a charging place, as in films, in a square of 2. */
const BOLT = new Path2D("M.2-1-.6 .15H-.05L-.2 1 .6-.15H.05Z");

/** Paints the ground into a canvas of its own, again only when it changes. */
export class Ground {
  #painted = "";
  #covered = { key: "", step: -1 };
  #masks = [0, 1].map(() => document.createElement("canvas"));

  /**
   * @param {import("page/episode").Episode} episode
   * @param {number} likely smallest probability of a cell worth showing
   * @param {number[][][]} places whose footprints are covered at each instant
   */
  constructor(episode, likely, places = episode.position) {
    this.episode = episode;
    this.places = places;
    this.likely = likely;
    this.edge = episode.cells ? episode.cellEdge : 0;
    this.canvas = document.createElement("canvas");
  }

  /**
   * The ground at an instant; true if the canvas was painted again.
   * @param {import("page/geography").Frame} frame
   * @param {number} step
   * @param {Set<string>} layers
   * @param {import("page/theme").Theme} theme
   */
  paint(frame, step, layers, theme) {
    const place = [frame.width, frame.height, frame.left, frame.top, frame.scale].join();
    const [covered, belief] = [layers.has("covered"), layers.has("belief") && this.episode.belief !== null];
    const key = [place, theme.dark, covered, belief, covered || belief ? step : ""].join();
    if (key === this.#painted) return false;
    this.#painted = key;
    const context = sized(this.canvas, frame);
    this.#outline(context, frame);
    context.fillStyle = theme.land;
    context.fill("evenodd");
    context.save();
    context.clip("evenodd");
    if (covered) this.#coverage(context, frame, step, theme, place);
    if (belief) this.#belief(context, frame, step, theme);
    this.#points(context, frame, theme);
    context.restore();
    this.#hatch(context, frame, theme);
    this.#outline(context, frame);
    context.strokeStyle = theme.edge;
    context.lineWidth = Math.max(1.4, frame.width / 600);
    context.stroke();
    return true;
  }

  #outline(context, frame, rings = this.episode.polygons.flat()) {
    context.beginPath();
    for (const ring of rings) {
      ring.forEach((corner, i) => context[i ? "lineTo" : "moveTo"](...frame.pixel(corner)));
      context.closePath();
    }
  }

  #points(context, frame, theme) {
    const size = Math.min(Math.max(frame.width / 500, 1), 2);
    context.fillStyle = theme.point;
    context.beginPath();
    for (const point of this.episode.landing_points) {
      const [x, y] = frame.pixel(point);
      context.moveTo(x + size, y);
      context.arc(x, y, size, 0, 2 * Math.PI);
    }
    context.fill();
    context.fillStyle = theme.charge;
    for (const point of this.episode.about.charging_points ?? []) {
      const [mark, scale] = [new Path2D(), frame.width / 70];
      mark.addPath(BOLT, new DOMMatrix([scale, 0, 0, scale, ...frame.pixel(point)]));
      context.fill(mark);
    }
  }

  /** Lines across the holes of the region, which are no-fly zones. */
  #hatch(context, frame, theme) {
    const holes = this.episode.polygons.flatMap((rings) => rings.slice(1));
    context.save();
    this.#outline(context, frame, holes);
    context.clip();
    for (let x = -frame.height; x < frame.width; x += frame.width / 70) {
      context.moveTo(x, frame.height);
      context.lineTo(x + frame.height, 0);
    }
    context.strokeStyle = theme.edge;
    context.lineWidth = frame.width / 900;
    context.stroke();
    context.restore();
  }

  /** Footprints at all instants so far, and again those of late, which fade; painted ones stay in the masks. */
  #coverage(context, frame, step, theme, place) {
    const key = place + theme.dark;
    let masks = this.#masks.map((mask) => mask.getContext("2d"));
    if (this.#covered.key !== key || this.#covered.step > step) {
      masks = this.#masks.map((mask) => sized(mask, frame));
      this.#covered = { key, step: -1 };
    }
    for (let instant = this.#covered.step + 1; instant <= step; instant++) {
      masks[1].globalCompositeOperation = "destination-out";
      masks[1].fillStyle = `rgb(0 0 0 / ${FADE})`;
      masks[1].fillRect(0, 0, frame.width, frame.height);
      masks[1].globalCompositeOperation = "source-over";
      for (const mask of masks) {
        mask.fillStyle = theme.covered;
        mask.beginPath();
        for (const at of this.places[instant]) {
          const [x, y] = frame.pixel(at);
          mask.moveTo(x, y);
          mask.arc(x, y, this.episode.radius * frame.scale, 0, 2 * Math.PI);
        }
        mask.fill();
      }
    }
    this.#covered.step = step;
    for (const [i, opacity] of COVERED.entries()) {
      context.globalAlpha = opacity;
      context.drawImage(this.#masks[i], 0, 0);
    }
    context.globalAlpha = 1;
  }

  #belief(context, frame, step, theme) {
    const size = this.edge * frame.scale;
    const sources = this.episode.belief[step];
    sources[0].forEach((_, cell) => {
      const probability = 1 - sources.reduce((none, one) => none * (1 - one[cell]), 1); // of any source
      if (probability <= this.likely) return;
      const strength = 1 - Math.log(probability) / Math.log(this.likely);
      const [x, y] = frame.pixel(this.episode.cells[cell]);
      const [left, top] = [Math.round(x - size / 2), Math.round(y - size / 2)];
      const [right, bottom] = [Math.round(x + size / 2), Math.round(y + size / 2)];
      context.fillStyle = faint(theme.belief, (OPACITY * strength).toFixed(3));
      context.fillRect(left, top, right - left, bottom - top);
    });
  }
}

/** The empty context of a canvas that has the size of a frame. */
function sized(canvas, frame) {
  canvas.width = frame.width;
  canvas.height = frame.height;
  return canvas.getContext("2d");
}
