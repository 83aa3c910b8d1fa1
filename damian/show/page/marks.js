/** The marks of both views, in pixels: UAVs, rings of belief, the source, messages, batteries. */

import { faint } from "page/theme";

const FONT = "600 11px system-ui, sans-serif";

/** Outline of a UAV that flies to the north, as in films: east, north. */
export const DART = [
  [0, 1],
  [0.62, -0.8],
  [0, -0.42],
  [-0.62, -0.8],
];

/** A UAV, turned to its heading [rad, clockwise from north]. */
export function dart(context, [x, y], heading, colour, rim, size = 10) {
  context.save();
  context.translate(x, y);
  context.rotate(heading);
  context.beginPath();
  DART.forEach(([east, north], i) => context[i ? "lineTo" : "moveTo"](east * size, -north * size));
  context.closePath();
  context.fillStyle = colour;
  context.strokeStyle = rim;
  context.lineWidth = 1.2;
  context.lineJoin = "round";
  context.fill();
  context.stroke();
  context.restore();
}

/** A ring where the server believes a UAV to be. */
export function ghost(context, [x, y], colour, size = 9) {
  context.strokeStyle = colour;
  context.lineWidth = size / 4.5;
  context.beginPath();
  context.arc(x, y, size, 0, 2 * Math.PI);
  context.stroke();
}

/** The way from where a UAV is to where it is believed to be: dotted, but one of many thin. */
export function error(context, from, to, colour, dotted = true) {
  context.save();
  if (dotted) context.setLineDash([1.5, 4]);
  context.lineCap = "round";
  context.strokeStyle = colour;
  context.lineWidth = dotted ? 1.6 : 1;
  context.beginPath();
  context.moveTo(...from);
  context.lineTo(...to);
  context.stroke();
  context.restore();
}

/** The source: a star, filled while it emits. */
export function star(context, [x, y], emits, theme) {
  context.beginPath();
  for (let corner = 0; corner < 10; corner++) {
    const [radius, angle] = [corner % 2 ? 4 : 10, (corner * Math.PI) / 5];
    context.lineTo(x + radius * Math.sin(angle), y - radius * Math.cos(angle));
  }
  context.closePath();
  context.fillStyle = emits ? theme.ink : theme.paper;
  context.strokeStyle = emits ? theme.paper : theme.ink;
  context.lineJoin = "round";
  context.lineWidth = emits ? 2.6 : 1.5;
  context.stroke();
  context.fill();
}

/** A message under way: a dot in a circle that closes until it arrives, with the share of its way. */
export function parcel(context, [x, y], share, colour, theme, size = 6) {
  context.beginPath();
  context.arc(x, y, size, 0, 2 * Math.PI);
  context.fillStyle = faint(theme.paper, 0.85);
  context.fill();
  context.strokeStyle = faint(colour, 0.3);
  context.lineWidth = 2;
  context.stroke();
  context.beginPath();
  context.arc(x, y, size, -Math.PI / 2, (2 * share - 0.5) * Math.PI);
  context.strokeStyle = colour;
  context.stroke();
  dot(context, [x, y], size / 2.7, colour);
}

export function dot(context, [x, y], radius, colour) {
  context.fillStyle = colour;
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
}

/** Where a late message arrives. */
export function arrow(context, [x, y], size, colour) {
  context.fillStyle = colour;
  context.beginPath();
  context.moveTo(x + size, y);
  context.lineTo(x - size, y - size);
  context.lineTo(x - size, y + size);
  context.fill();
}

/** A lost message. */
export function cross(context, [x, y], colour, size = 4.5) {
  context.strokeStyle = colour;
  context.lineWidth = 1.8;
  context.lineCap = "round";
  context.beginPath();
  context.moveTo(x - size, y - size);
  context.lineTo(x + size, y + size);
  context.moveTo(x - size, y + size);
  context.lineTo(x + size, y - size);
  context.stroke();
}

/** The level [%] of a battery, below a UAV. */
export function battery(context, [x, y], level, colour, theme) {
  const [width, height, left, top] = [20, 4, x - 10, y + 13];
  context.fillStyle = faint(theme.paper, 0.9);
  context.strokeStyle = theme.muted;
  context.lineWidth = 1;
  context.beginPath();
  context.roundRect(left - 1, top - 1, width + 2, height + 2, 2);
  context.fill();
  context.stroke();
  context.fillStyle = level < 20 ? theme.alarm : colour;
  context.fillRect(left, top, (width * Math.max(level, 0)) / 100, height);
}

/** Where a name may stand beside its mark, the best places first. */
const AROUND = [1, 2, 4].flatMap((far) =>
  [
    [1, 0.6],
    [1, -0.6],
    [-1, 0.6],
    [-1, -0.6],
    [0, 1],
    [0, -1],
    [1, 1],
    [-1, -1],
  ].map((toward) => ({ toward, near: 3 + 6 * far })),
);
/** Area [px²] that a name may cover rather than move, so that names do not dance. */
const CALM = 60;

/**
 * Names beside their marks, where they cover least.
 * @param {{key: string, at: number[], text: string, colour: string}[]} named
 * @param {number[][]} others places that names should not cover
 * @param {Map<string, number>} before the places of the names in the picture before, which are changed
 */
export function names(context, named, others, before, theme) {
  const { clientWidth: width, clientHeight: height } = context.canvas;
  const marked = [...named.map(({ at }) => at), ...others];
  const covered = marked.map(([x, y]) => [x - 7, y - 7, x + 7, y + 7]);
  context.font = FONT;
  for (const { key, at, text, colour } of named) {
    const half = [context.measureText(text).width / 2 + 1, 6];
    const boxes = AROUND.map(({ toward, near }) => {
      const [x, y] = at.map((value, axis) => value + toward[axis] * (half[axis] + near));
      return [x - half[0], y - half[1], x + half[0], y + half[1]];
    });
    const costs = boxes.map((box, i) => {
      const outside = box[0] < 0 || box[1] < 0 || box[2] > width || box[3] > height;
      const calm = before.get(key) === i ? -CALM : 0;
      return covered.reduce((sum, other) => sum + common(box, other), outside ? 500 : calm);
    });
    const best = costs.indexOf(Math.min(...costs));
    const [left, top, right, bottom] = boxes[best];
    before.set(key, best);
    covered.push(boxes[best]);
    if (best >= 8) {
      context.strokeStyle = colour;
      context.lineWidth = 1;
      context.beginPath();
      context.moveTo(...at);
      context.lineTo((left + right) / 2, (top + bottom) / 2);
      context.stroke();
    }
    label(context, [left + 1, (top + bottom) / 2], text, colour, theme);
  }
}

/** Area that two boxes have in common. */
function common(one, other) {
  const width = Math.min(one[2], other[2]) - Math.max(one[0], other[0]);
  const height = Math.min(one[3], other[3]) - Math.max(one[1], other[1]);
  return Math.max(width, 0) * Math.max(height, 0);
}

/** A short text that stays readable on any ground. */
export function label(context, [x, y], text, colour, theme) {
  context.font = FONT;
  context.textBaseline = "middle";
  context.lineJoin = "round";
  context.lineWidth = 3;
  context.strokeStyle = faint(theme.paper, 0.85);
  context.strokeText(text, x, y);
  context.fillStyle = colour;
  context.fillText(text, x, y);
}

/** A number with at most one decimal; with none from a size on. */
export function plain(value, large = Number.POSITIVE_INFINITY) {
  return String(value >= large ? Math.round(value) : Math.round(value * 10) / 10);
}
