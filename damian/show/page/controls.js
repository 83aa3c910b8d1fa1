/** Buttons, the slider of the time, and keys. */

import { addBrush } from "page/brush";
import { plain } from "page/marks";
import { SPEEDS } from "page/player";

/** The layers, with the marks that stand for them and their names; keys 1 to 5 in this order. */
export const LAYERS = [
  ["truth", "▲", "Truth"],
  ["believed", "◯", "Believed"],
  ["messages", "•─", "Messages"],
  ["covered", "▒", "Covered"],
  ["belief", "■", "Belief"],
];

/** The views, in the order in which the key V shows them. */
const VIEWS = { beside: "Side by side", "2d": "2D", "3d": "3D" };

/** Outlines of the buttons of the time, in a square of 16. */
const ICONS = {
  play: "M4 2.5v11l9.5-5.5z",
  pause: "M3.5 2.5h3.2v11H3.5zM9.3 2.5h3.2v11H9.3z",
  back: "M11 3v10L4.5 8z",
  on: "M5 3v10l6.5-5z",
  first: "M3 3h2v10H3zM13 3v10L6 8z",
  last: "M11 3h2v10h-2zM3 3v10l7-5z",
};

/**
 * What the tools set.
 * @typedef {{layers: Set<string>, view: "beside" | "2d" | "3d"}} Settings
 */

/** Buttons for the view and the layers. Returns functions by key. */
export function addTools(parent, settings, hasBelief, changed) {
  const views = group(parent, "View");
  const layers = group(parent, "Layers");
  const shown = [];
  const show = () => {
    for (const [button, isOn] of shown) button.setAttribute("aria-pressed", String(isOn()));
    changed();
  };
  const add = (place, text, isOn, press) => {
    const made = button(place, text, () => {
      press();
      show();
    });
    shown.push([made, isOn]);
    return made;
  };
  for (const [view, text] of Object.entries(VIEWS)) {
    add(
      views,
      text,
      () => settings.view === view,
      () => (settings.view = view),
    ).dataset.view = view;
  }
  const toggle = (name) => settings.layers[settings.layers.has(name) ? "delete" : "add"](name);
  const names = Object.keys(VIEWS);
  const keys = { v: () => (settings.view = names[(names.indexOf(settings.view) + 1) % names.length]) };
  LAYERS.forEach(([name, sign, text], i) => {
    const made = add(
      layers,
      text,
      () => settings.layers.has(name),
      () => toggle(name),
    );
    made.dataset.layer = name;
    made.dataset.sign = sign;
    made.title = `${text} (key ${i + 1})`;
    if (name === "belief" && !hasBelief) made.disabled = true;
    else keys[i + 1] = () => toggle(name);
  });
  show();
  return Object.fromEntries(Object.entries(keys).map(([key, press]) => [key, () => (press(), show())]));
}

/** The list of the UAVs, of which one may be chosen. */
export function addList(parent, names, theme) {
  const list = document.createElement("select");
  list.setAttribute("aria-label", "chosen UAV");
  list.append(new Option("all UAVs", ""), ...names.map((name, uav) => new Option(name, uav)));
  list.addEventListener("change", () => theme.choose(list.value === "" ? null : Number(list.value)));
  theme.onChange(() => (list.value = theme.chosen ?? ""));
  parent.append(list);
}

/** The buttons and the slider of the time. */
export function addTransport(parent, player) {
  const first = sign(parent, ICONS.first, () => player.seek(0), "first instant (Home)");
  const back = sign(parent, ICONS.back, () => player.step(-1), "one instant back (←)");
  const play = sign(parent, ICONS.play, () => player.toggle(), "play (Space)");
  play.classList.add("play");
  const on = sign(parent, ICONS.on, () => player.step(1), "one instant on (→)");
  const last = sign(parent, ICONS.last, () => player.seek(player.end), "last instant (End)");
  const buttons = document.createElement("div");
  buttons.className = "buttons";
  buttons.append(first, back, play, on, last);
  const slider = document.createElement("input");
  Object.assign(slider, { type: "range", min: 0, max: player.end || 1, step: "any", value: 0 });
  slider.setAttribute("aria-label", "time");
  slider.addEventListener("input", () => player.seek(Number(slider.value)));
  const time = document.createElement("output");
  const speed = document.createElement("select");
  speed.setAttribute("aria-label", "speed");
  speed.append(...SPEEDS.map((steps) => new Option(`${steps} step${steps > 1 ? "s" : ""}/s`, steps)));
  speed.addEventListener("change", () => {
    player.speed = Number(speed.value);
    player.changed();
  });
  const times = document.createElement("div");
  times.className = "times";
  times.append(slider);
  parent.append(buttons, times, time, speed);
  addBrush(times, player);
  player.onChange(() => {
    play.setAttribute("aria-label", player.playing ? "pause (Space)" : "play (Space)");
    play.querySelector("path").setAttribute("d", player.playing ? ICONS.pause : ICONS.play);
    slider.value = player.time;
    slider.style.setProperty("--share", player.end ? player.time / player.end : 1);
    const shown = player.instants.findLast((instant) => instant <= player.time);
    time.textContent = `${plain(shown)} / ${plain(player.end)} s`;
    slider.setAttribute("aria-valuetext", `${plain(shown)} s of ${plain(player.end)} s`);
    speed.value = player.speed;
  });
}

/** The keys of the page. */
export function listen(player, keys) {
  const presses = {
    " ": () => player.toggle(),
    ArrowLeft: (event) => player.step(event.shiftKey ? -10 : -1),
    ArrowRight: (event) => player.step(event.shiftKey ? 10 : 1),
    ArrowUp: () => player.hurry(1),
    ArrowDown: () => player.hurry(-1),
    Home: () => player.seek(0),
    End: () => player.seek(player.end),
    t: (event) => player.nearer(event.shiftKey ? 0.5 : 2),
    a: () => player.showAll(),
    ...keys,
  };
  addEventListener("keydown", (event) => {
    const press = presses[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    const writes =
      event.target.matches("select, .brush input") ||
      (event.key === " " && event.target.matches("button, summary"));
    const scrolls = /^Arrow(Up|Down)$/.test(event.key) && event.target.matches(".rows");
    if (!press || writes || scrolls || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    press(event);
  });
}

function group(parent, name) {
  const made = document.createElement("div");
  made.className = "group";
  made.setAttribute("role", "group");
  made.setAttribute("aria-label", name);
  parent.append(made);
  return made;
}

/** A button with an icon. */
function sign(parent, outline, press, name) {
  const made = button(parent, "", press, name);
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 16 16");
  svg.setAttribute("aria-hidden", "true");
  const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
  path.setAttribute("d", outline);
  svg.append(path);
  made.append(svg);
  return made;
}

function button(parent, text, press, name) {
  const made = document.createElement("button");
  made.type = "button";
  made.textContent = text;
  if (name) {
    made.setAttribute("aria-label", name);
    made.title = name;
  }
  made.addEventListener("click", press);
  parent.append(made);
  return made;
}
