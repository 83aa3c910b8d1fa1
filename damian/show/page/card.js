/** One episode on the page: its views, its messages, its charts and its numbers. */

import { ChartView } from "page/charts";
import { spoken } from "page/geography";
import { OPACITY } from "page/ground";
import { Lanes } from "page/lanes";
import { MapView } from "page/map";
import { Readout } from "page/readout";
import { SpaceView } from "page/space";
import { listenToZoom } from "page/zoom";

/** Largest distance from a UAV at which a click chooses it [px]. */
const REACH = 14;

export class Card {
  /**
   * @param {HTMLElement} parent
   * @param {import("page/episode").Episode} episode
   * @param {{player: object, theme: object, zoom: object, likely: number}} page
   */
  constructor(parent, episode, { player, theme, zoom, likely }) {
    Object.assign(this, { episode, player, theme, likely });
    this.element = make(parent, "article", "card");
    this.element.setAttribute("aria-label", episode.title);
    const body = make(this.element, "div", "body");
    const head = make(body, "div", "head");
    make(head, "h2").textContent = episode.title;
    this.line = make(head, "p", "line");
    this.view = make(body, "div", "view");
    const [west, south, east, north] = episode.limits;
    this.view.style.setProperty("--aspect", Math.min(Math.max((east - west) / (north - south), 0.8), 2));
    this.layers = ["map", "space", "marks", "known"].map((name) => make(this.view, "canvas", name));
    for (const side of ["What the server believed", "What was true"]) make(this.view, "p", "side").textContent = side;
    const shown = episode.hasSource ? "UAVs and source" : "UAVs";
    const described = `where ${shown} are in ${episode.title}; the table below has the numbers`;
    for (const canvas of this.layers.slice(0, 2)) describe(canvas, described);
    this.layers[2].setAttribute("aria-hidden", "true");
    describe(this.layers[3], `where the server believes the UAVs to be in ${episode.title}`);
    this.hint = make(this.view, "p", "hint");
    this.map = new MapView(this.layers[0], episode, likely, zoom);
    this.known = new MapView(this.layers[3], episode, likely, zoom, true);
    for (const map of [this.map, this.known]) listenToZoom(map, zoom, () => player.changed());
    this.#followPointer();
    const messages = make(body, "div", "messages");
    const note = make(messages, "p", "note");
    this.rows = make(messages, "div", "rows");
    this.rows.tabIndex = 0; // so that keys can scroll it
    this.rows.setAttribute("role", "group");
    this.rows.setAttribute("aria-label", "rows of messages");
    const rows = make(this.rows, "canvas", "lanes");
    describe(rows, "messages over time, in a row for each UAV");
    this.lanes = new Lanes(rows, note, episode, player);
    if (episode.belief) this.#addScale(likely);
    this.figures = make(body, "div", "charts");
    this.charts = [];
    const table = make(make(body, "div", "numbers"), "table");
    table.createCaption().textContent = "UAVs at this instant";
    this.readout = new Readout(this.line, table, episode, (uav) => theme.choose(uav));
  }

  /** Add the charts, with the ranges of their values by key. */
  addCharts(charts, ranges) {
    const page = { player: this.player, theme: this.theme };
    const made = (chart) => new ChartView(this.figures, this.episode, chart, ranges.get(chart.key), page);
    this.charts = charts.map(made);
  }

  /** Draw the time of the page. */
  draw({ layers, view }) {
    const now = this.episode.at(this.player.time);
    if (this.view.dataset.view !== view) {
      this.view.dataset.view = this.element.dataset.view = view; // which moves the charts
      this.resize();
    }
    if (this.scale) this.scale.hidden = !layers.has("belief");
    if (this.chosen !== this.theme.chosen) this.#showRow();
    if (view === "3d") this.#space()?.draw(now, layers, this.theme);
    else if (view === "2d") this.map.draw(now, layers, this.theme);
    else {
      const without = (...names) => new Set([...layers].filter((name) => !names.includes(name)));
      this.known.draw(now, without("truth", "messages"), this.theme);
      this.map.draw(now, without("believed", "belief"), this.theme);
    }
    this.lanes.draw(now, this.theme);
    for (const chart of this.charts) chart.draw(now);
    this.readout.draw(now, this.theme);
  }

  resize() {
    for (const chart of this.charts) chart.resize();
  }

  /** The view of the space, made when it is first wanted; null without WebGL. */
  #space() {
    if (this.space !== undefined) return this.space;
    try {
      const [, space, marks] = this.layers;
      this.space = new SpaceView(space, marks, this.episode, this.likely, () => this.player.changed());
    } catch (problem) {
      this.space = null;
      make(this.view, "p", "problem").textContent = "3D needs WebGL, which this browser does not offer";
      console.warn(problem.message);
    }
    return this.space;
  }

  /** The scale of the belief's colours. */
  #addScale(likely) {
    this.scale = make(this.view, "p", "scale");
    const ends = [likely, 1].map((end) => (make(this.scale, "span").textContent = String(end)));
    this.scale.style.setProperty("--strongest", `${100 * OPACITY}%`);
    this.scale.title = `belief: probability of a cell, from ${ends[0]} to ${ends[1]}, on a logarithmic scale`;
  }

  /** Scroll to the row of the chosen UAV. */
  #showRow() {
    this.chosen = this.theme.chosen;
    if (this.chosen !== null)
      this.rows.scrollTop = this.lanes.top(this.chosen) - this.rows.clientHeight / 2;
  }

  /** Say which UAV and which place is under the pointer; a click on a UAV or a ring chooses it. */
  #followPointer() {
    const at = (event) => {
      const border = event.target.getBoundingClientRect();
      return [event.clientX - border.left, event.clientY - border.top];
    };
    const view = ({ target }) =>
      this.view.dataset.view === "3d" ? this.space : target === this.known.canvas ? this.known : this.map;
    const uavAt = (event) => {
      const [x, y] = at(event);
      const far = (shown) => Math.hypot(shown.at[0] - x, shown.at[1] - y);
      const nearest = (view(event)?.shown ?? []).toSorted((one, other) => far(one) - far(other))[0];
      return nearest && far(nearest) < REACH ? nearest.uav : null;
    };
    this.view.addEventListener("pointermove", (event) => {
      const [place, uav] = [view(event)?.place(...at(event)), uavAt(event)];
      const name = uav === null ? "" : `${this.episode.names[uav]}: `;
      this.hint.textContent = place ? name + spoken(place, this.episode.origin) : "";
      this.view.classList.toggle("at-uav", uav !== null);
    });
    this.view.addEventListener("pointerleave", () => (this.hint.textContent = ""));
    let pressed = [0, 0];
    this.view.addEventListener("pointerdown", (event) => (pressed = at(event)), { capture: true });
    this.view.addEventListener("click", (event) => {
      const [x, y] = at(event);
      if (Math.hypot(x - pressed[0], y - pressed[1]) < REACH / 3) this.theme.choose(uavAt(event));
    });
  }
}

function make(parent, kind, name = "") {
  const made = document.createElement(kind);
  made.className = name;
  parent.append(made);
  return made;
}

function describe(canvas, text) {
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", text);
}
