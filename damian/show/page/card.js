/** One episode on the page: its views, its messages, its charts and its numbers. */

import { ChartView } from "page/charts";
import { spoken } from "page/geography";
import { Lanes } from "page/lanes";
import { MapView } from "page/map";
import { Readout } from "page/readout";
import { SpaceView } from "page/space";
import { listenToZoom } from "page/zoom";

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
    this.layers = ["map", "space", "marks"].map((name) => make(this.view, "canvas", name));
    const described = `where UAVs and source are in ${episode.title}; the table below has the numbers`;
    for (const canvas of this.layers.slice(0, 2)) describe(canvas, described);
    this.layers[2].setAttribute("aria-hidden", "true");
    this.hint = make(this.view, "p", "hint");
    this.map = new MapView(this.layers[0], episode, likely, zoom);
    listenToZoom(this.map, zoom, () => player.changed());
    this.#followPointer();
    const rows = make(body, "canvas", "lanes");
    describe(
      rows,
      "messages over time: for each UAV dots that arrive at once, bars that are late, crosses that are lost",
    );
    this.lanes = new Lanes(rows, episode, player);
    this.figures = make(body, "div", "charts");
    this.charts = [];
    const table = make(make(body, "div", "numbers"), "table");
    table.createCaption().textContent = "UAVs at this instant";
    this.readout = new Readout(this.line, table, episode);
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
    this.view.dataset.view = view;
    if (view === "3d") this.#space()?.draw(now, layers, this.theme);
    else this.map.draw(now, layers, this.theme);
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

  /** Say which place is under the pointer. */
  #followPointer() {
    this.view.addEventListener("pointermove", (event) => {
      const border = this.view.getBoundingClientRect();
      const view = this.view.dataset.view === "3d" ? this.space : this.map;
      const place = view?.place(event.clientX - border.left, event.clientY - border.top);
      this.hint.textContent = place ? spoken(place, this.episode.origin) : "";
    });
    this.view.addEventListener("pointerleave", () => (this.hint.textContent = ""));
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
