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
 * @property {Map<string, number>} places of the names in the picture before
 */

/**
 * Draws all marks, the chosen UAV on top; returns the UAVs and rings.
 * @param {Scene} scene
 * @returns {{uav: number, at: number[]}[]}
 */
export function drawMarks(scene) {
  const { context, episode, layers, theme } = scene;
  const uavs = [...Array(episode.nAgents).keys()].sort(
    (one, other) => (one === theme.chosen) - (other === theme.chosen),
  );
  if (layers.has("messages")) drawMessages(scene);
  const sources = layers.has("truth") && episode.source ? [...episode.source[0].keys()] : [];
  if (layers.has("truth") && episode.requests) drawRequests(scene);
  const stars = sources.map((number) => drawSource(scene, number));
  const rings = layers.has("believed") ? uavs.map((uav) => drawBelieved(scene, uav)) : [];
  const darts = layers.has("truth") ? uavs.map((uav) => drawUav(scene, uav)) : [];
  const shown = [...darts, ...rings.filter(Boolean)].reverse(); // the chosen one is named first
  const named = shown.filter(({ uav }) => theme.tells(uav));
  marks.names(context, named, stars, scene.places, theme);
  return shown;
}

/** A UAV, and its battery if it is used. */
function drawUav({ context, episode, now, theme, pixel, darts }, uav) {
  const [at, colour] = [pixel(episode.place(uav, now)), theme.mark(uav, episode.late(uav, now))];
  const tells = theme.tells(uav);
  if (darts) marks.dart(context, at, episode.heading(uav, now), colour, theme.rim(uav), tells ? 10 : 8);
  if (episode.usesBattery && tells) marks.battery(context, at, episode.battery[now.step][uav], colour, theme);
  return { uav, at, key: `dart ${uav}`, text: episode.ids[uav], colour: theme.text(uav) };
}

/** Where the server believes a UAV to be, if it differs in time from the truth or the truth is not shown. */
function drawBelieved({ context, episode, now, layers, theme, pixel }, uav) {
  const [age, colour] = [episode.age[now.step][uav], theme.mark(uav, episode.late(uav, now))];
  const at = pixel([...episode.believed[now.step][uav], 0]);
  if (layers.has("truth")) {
    if (age === 0) return undefined;
    marks.error(context, pixel(episode.place(uav, now)), at, colour, theme.tells(uav));
  }
  marks.ghost(context, at, colour, theme.tells(uav) ? 9 : 5);
  const text = age > 0 ? `${episode.ids[uav]}, ${marks.plain(age)} s` : episode.ids[uav];
  return { uav, at, key: `ring ${uav}`, text, colour: theme.text(uav) };
}

/** Open requests: squares. */
function drawRequests({ context, episode, now, theme, pixel }) {
  context.strokeStyle = theme.ink;
  context.lineWidth = 1.5;
  for (const [east, north, open] of episode.requests[now.step]) {
    const [x, y] = pixel([east, north, 0]);
    if (open) context.strokeRect(x - 5, y - 5, 10, 10);
  }
}

/** A source, with a wave that spreads over the step while it emits. */
function drawSource({ context, episode, now, theme, pixel }, number) {
  const at = pixel([...episode.sourcePlace(number, now), 0]);
  const emits = episode.emits[now.step][number];
  if (emits) {
    context.strokeStyle = faint(theme.ink, 0.45 * (1 - now.share));
    context.lineWidth = 1.5;
    context.beginPath();
    context.arc(...at, 12 + 16 * now.share, 0, 2 * Math.PI);
    context.stroke();
  }
  marks.star(context, at, emits, theme);
  return at;
}

/** Messages under way where they were sent, and crosses for those that were just lost. */
function drawMessages({ context, episode, now, theme, pixel, rise }) {
  for (const { uav, step, sent, arrives, lost } of episode.underWay(now)) {
    const [east, north, up] = episode.position[step][uav];
    const share = lost ? 0.5 : (now.time - sent) / (arrives - sent);
    const [from, at] = [0, share * rise].map((above) => pixel([east, north, up + above]));
    if (lost) {
      marks.cross(context, at, theme.lost(uav));
      continue;
    }
    context.strokeStyle = faint(theme.uav(uav), 0.5);
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(...from);
    context.lineTo(...at);
    context.stroke();
    marks.parcel(context, at, share, theme.uav(uav), theme, theme.tells(uav) ? 6 : 3);
  }
}
