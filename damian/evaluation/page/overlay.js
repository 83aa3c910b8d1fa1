/**
 * What is drawn on top of the ground in both views, at the pixels that a view gives: UAVs, rings of
 * belief, the source, and messages under way.
 */

import * as marks from "page/marks";
import { faint } from "page/theme";

/**
 * @param {CanvasRenderingContext2D} context
 * @param {import("page/episode").Episode} episode
 * @param {import("page/episode").Now} now
 * @param {Set<string>} layers
 * @param {import("page/theme").Theme} theme
 * @param {object} view with `pixel(place)`, the pixel of a place [east, north, up], and `darts`: does it want
 *   UAVs as marks? `rise`: height to which messages rise [m]
 */
export function drawMarks(context, episode, now, layers, theme, view) {
  const uavs = [...Array(episode.nAgents).keys()];
  if (layers.has("messages")) messages(context, episode, now, theme, view);
  if (layers.has("truth")) source(context, episode, now, theme, view);
  if (layers.has("believed")) for (const uav of uavs) believed(context, episode, now, uav, layers, theme, view);
  if (!layers.has("truth")) return;
  for (const uav of uavs) {
    const pixel = view.pixel(episode.place(uav, now));
    if (view.darts) marks.dart(context, pixel, episode.heading(uav, now), theme.uav(uav), theme);
    if (uavs.length > theme.uavs.length) {
      marks.label(context, [pixel[0] + 9, pixel[1] + 9], String(uav), theme.uav(uav), theme);
    }
    if (episode.usesBattery) marks.battery(context, pixel, episode.battery[now.step][uav], theme.uav(uav), theme);
  }
}

/** Where the server believes a UAV to be, if it differs in time from the truth or the truth is not shown. */
function believed(context, episode, now, uav, layers, theme, view) {
  const [age, colour] = [episode.age[now.step][uav], theme.uav(uav)];
  const held = view.pixel([...episode.believed[now.step][uav], 0]);
  if (age > 0 && layers.has("truth")) {
    marks.error(context, view.pixel(episode.place(uav, now)), held, colour);
  }
  if (age > 0 || !layers.has("truth")) marks.ghost(context, held, age, colour, theme);
}

/** The source, with a wave that spreads over the step while it emits. */
function source(context, episode, now, theme, view) {
  const pixel = view.pixel([...episode.sourcePlace(now), 0]);
  if (episode.emits[now.step]) {
    context.strokeStyle = faint(theme.ink, 0.45 * (1 - now.share));
    context.lineWidth = 1.5;
    context.beginPath();
    context.arc(...pixel, 12 + 16 * now.share, 0, 2 * Math.PI);
    context.stroke();
  }
  marks.star(context, pixel, episode.emits[now.step], theme);
}

function messages(context, episode, now, theme, view) {
  for (const message of episode.underWay(now)) {
    const [east, north, up] = episode.position[message.step][message.uav];
    const colour = theme.uav(message.uav);
    if (message.lost) {
      marks.cross(context, view.pixel([east, north, up + view.rise / 2]), theme.ink);
      continue;
    }
    const share = (now.time - message.sent) / (message.arrives - message.sent);
    marks.parcel(context, view.pixel([east, north, up + share * view.rise]), share, colour, theme);
  }
}
