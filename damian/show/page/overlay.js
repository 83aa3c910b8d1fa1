/**
 * What is drawn on top of the ground in both views, at the pixels that a view gives: UAVs, rings of
 * belief, the source, and messages under way.
 */

import * as marks from "page/marks";
import { faint } from "page/theme";

/**
 * What to draw, when, and where.
 * @typedef {object} Scene
 * @property {CanvasRenderingContext2D} context
 * @property {import("page/episode").Episode} episode
 * @property {import("page/episode").Now} now
 * @property {Set<string>} layers
 * @property {import("page/theme").Theme} theme
 * @property {function(number[]): number[]} pixel of a place east, north, up [m]
 * @property {boolean} darts whether UAVs are drawn as marks
 * @property {number} rise height to which messages rise [m]
 */

/** @param {Scene} scene */
export function drawMarks(scene) {
  const { episode, layers } = scene;
  const uavs = [...Array(episode.nAgents).keys()];
  if (layers.has("messages")) drawMessages(scene);
  if (layers.has("truth")) drawSource(scene);
  if (layers.has("believed")) for (const uav of uavs) drawBelieved(scene, uav);
  if (layers.has("truth")) for (const uav of uavs) drawUav(scene, uav);
}

/** A UAV, its number if there are more of them than colours, and its battery if it is used. */
function drawUav({ context, episode, now, theme, pixel, darts }, uav) {
  const [at, colour] = [pixel(episode.place(uav, now)), theme.uav(uav)];
  if (darts) marks.dart(context, at, episode.heading(uav, now), colour, theme);
  if (episode.nAgents > theme.uavs.length) {
    marks.label(context, [at[0] + 9, at[1] + 9], episode.ids[uav], colour, theme);
  }
  if (episode.usesBattery) marks.battery(context, at, episode.battery[now.step][uav], colour, theme);
}

/** Where the server believes a UAV to be, if it differs in time from the truth or the truth is not shown. */
function drawBelieved({ context, episode, now, layers, theme, pixel }, uav) {
  const [age, colour] = [episode.age[now.step][uav], theme.uav(uav)];
  const held = pixel([...episode.believed[now.step][uav], 0]);
  if (age > 0 && layers.has("truth")) marks.error(context, pixel(episode.place(uav, now)), held, colour);
  if (age > 0 || !layers.has("truth")) marks.ghost(context, held, age, colour, theme);
}

/** The source, if it is known, with a wave that spreads over the step while it emits. */
function drawSource({ context, episode, now, theme, pixel }) {
  if (!episode.source) return;
  const at = pixel([...episode.sourcePlace(now), 0]);
  if (episode.emits[now.step]) {
    context.strokeStyle = faint(theme.ink, 0.45 * (1 - now.share));
    context.lineWidth = 1.5;
    context.beginPath();
    context.arc(...at, 12 + 16 * now.share, 0, 2 * Math.PI);
    context.stroke();
  }
  marks.star(context, at, episode.emits[now.step], theme);
}

/** Messages under way where they were sent, and crosses for those that were just lost. */
function drawMessages({ context, episode, now, theme, pixel, rise }) {
  for (const { uav, step, sent, arrives, lost } of episode.underWay(now)) {
    const [east, north, up] = episode.position[step][uav];
    const share = lost ? 0.5 : (now.time - sent) / (arrives - sent);
    const at = pixel([east, north, up + share * rise]);
    if (lost) marks.cross(context, at, theme.ink);
    else marks.parcel(context, at, share, theme.uav(uav), theme);
  }
}
