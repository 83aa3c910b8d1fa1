/** The marks of both views, in pixels: UAVs, rings of belief, the source, messages, batteries. */

import { faint } from "page/theme";

/** Outline of a UAV that flies to the north, as in films: east, north. */
export const DART = [
  [0, 1],
  [0.62, -0.8],
  [0, -0.42],
  [-0.62, -0.8],
];

/** A UAV, turned to its heading [rad, clockwise from north]. */
export function dart(context, [x, y], heading, colour, theme, size = 10) {
  context.save();
  context.translate(x, y);
  context.rotate(heading);
  context.beginPath();
  DART.forEach(([east, north], i) => context[i ? "lineTo" : "moveTo"](east * size, -north * size));
  context.closePath();
  context.fillStyle = colour;
  context.strokeStyle = theme.paper;
  context.lineWidth = 1.2;
  context.lineJoin = "round";
  context.fill();
  context.stroke();
  context.restore();
}

/** A ring where the server believes a UAV to be, with the age [s] of what it knows if that is old. */
export function ghost(context, [x, y], age, colour, theme) {
  context.strokeStyle = colour;
  context.lineWidth = 2;
  context.beginPath();
  context.arc(x, y, 9, 0, 2 * Math.PI);
  context.stroke();
  if (age > 0) label(context, [x + 12, y - 11], `${plain(age)} s`, colour, theme);
}

/** The dotted way from where a UAV is to where it is believed to be. */
export function error(context, from, to, colour) {
  context.save();
  context.setLineDash([1.5, 4]);
  context.lineCap = "round";
  context.strokeStyle = colour;
  context.lineWidth = 1.6;
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
export function parcel(context, [x, y], share, colour, theme) {
  context.beginPath();
  context.arc(x, y, 6, 0, 2 * Math.PI);
  context.fillStyle = faint(theme.paper, 0.85);
  context.fill();
  context.strokeStyle = faint(colour, 0.3);
  context.lineWidth = 2;
  context.stroke();
  context.beginPath();
  context.arc(x, y, 6, -Math.PI / 2, (2 * share - 0.5) * Math.PI);
  context.strokeStyle = colour;
  context.stroke();
  dot(context, [x, y], 2.2, colour);
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

/** A short text that stays readable on any ground. */
export function label(context, [x, y], text, colour, theme) {
  context.font = "600 11px system-ui, sans-serif";
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
