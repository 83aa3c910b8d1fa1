/** The page: a card for each episode, one time line, and tools for all of them. */

import { Card } from "page/card";
import { chartsOf, rangeOf } from "page/charts";
import { addList, addTools, addTransport, listen } from "page/controls";
import { Episode } from "page/episode";
import { Player } from "page/player";
import { Theme } from "page/theme";
import { Zoom } from "page/zoom";

const replay = JSON.parse(document.getElementById("replay").textContent);
const episodes = replay.episodes.map((file) => new Episode(file));
const largest = episodes.reduce((one, other) => (other.nAgents > one.nAgents ? other : one));
const theme = new Theme(replay.colours, largest.nAgents);
const player = new Player(episodes);
const zoom = new Zoom();
const worst = ({ errors, worst: step }) => errors[step];
const mistaken = episodes.reduce((one, other) => (worst(other) > worst(one) ? other : one));
player.open(mistaken.time[mistaken.worst]);
const hasBelief = episodes.some((episode) => episode.belief !== null);
const settings = {
  view: episodes.length > 1 ? "2d" : "beside",
  layers: new Set(["truth", "believed", hasBelief ? "belief" : "covered", ...(theme.many ? [] : ["messages"])]),
};

const parent = document.getElementById("episodes");
parent.style.setProperty("--cards", episodes.length);
const cards = episodes.map(
  (episode) => new Card(parent, episode, { player, theme, zoom, likely: replay.likely }),
);
addCharts();
addTransport(document.getElementById("transport"), player);
const keys = addTools(document.getElementById("tools"), settings, hasBelief, () => player.changed());
addList(document.getElementById("tools"), largest.names, theme);
listen(player, { ...keys, ...zoomKeys(), Escape: () => theme.choose(null) });
player.onChange(() => cards.forEach((card) => card.draw(settings)));
new ResizeObserver(redraw).observe(parent);
theme.onChange(redraw);
document.getElementById("shared").textContent = replay.shared;
document.getElementById("motion").textContent = episodes.some((episode) => episode.instant)
  ? "A UAV reaches its target by the end of the step; between instants it is drawn on the straight way."
  : "Between instants UAVs are drawn on the straight way.";
document.documentElement.dataset.ready = "true";

/** Charts of the same kind have the same range in all episodes, so that they can be compared. */
function addCharts() {
  const battery = episodes.some((episode) => episode.usesBattery);
  const all = episodes.map((episode) => chartsOf(episode, theme, battery));
  const same = (key) => all.flat().filter((chart) => chart.key === key);
  const ranges = new Map(all[0].map(({ key }) => [key, rangeOf(same(key))]));
  cards.forEach((card, i) => card.addCharts(all[i], ranges));
}

function zoomKeys() {
  const keys = Object.entries(zoom.keys);
  return Object.fromEntries(keys.map(([key, press]) => [key, () => (press(), player.changed())]));
}

function redraw() {
  for (const card of cards) card.resize();
  player.changed();
}
