/** Charts over time, by uPlot: rewards by term, the return so far, ages of information, batteries. */

import { uPlot } from "libraries";

/** Width of the axis beside a chart, and the margin on its other side [px]. */
export const [GUTTER, MARGIN] = [52, 14];
/** Largest number of lines that a legend names; of more UAVs it names the chosen one. */
const NAMED = 6;
const FONT = "11px system-ui, sans-serif";

/**
 * What a chart shows. The value of an instant is that of the step before it (rewards), or holds until the
 * next one (ages); others change evenly.
 * @typedef {{key: string, title: string, lines: {name: string, values: number[], colour: Function}[],
 *   held: "before" | "after" | "no", digits: number, isByUav?: boolean}} Chart
 */
const ALIGN = { before: -1, after: 1 };

/** The charts of an episode. @returns {Chart[]} */
export function chartsOf(episode, theme, showsBattery) {
  const ink = () => theme.ink;
  const byUav = (rows) =>
    rows[0].map((_, uav) => ({
      name: episode.names[uav],
      values: rows.map((row) => row[uav]),
      colour: () => theme.uav(uav),
    }));
  const terms = [...episode.meanTerms].map(([name, values], i) => ({
    name: name.replaceAll("_", " "),
    values,
    colour: () => theme.term(i),
  }));
  const all = { name: "all terms", values: episode.meanReward, colour: ink };
  const charts = [
    {
      key: "return",
      title: "return so far",
      digits: 2,
      held: "no",
      lines: [{ name: "return", values: episode.returns, colour: ink }],
    },
    {
      key: "reward",
      title: "reward of each step, by term",
      digits: 3,
      held: "before",
      lines: terms.length ? terms : [all],
    },
    {
      key: "age",
      title: "age of information [s]",
      digits: 1,
      held: "after",
      lines: byUav(episode.age),
      isByUav: true,
    },
  ];
  const battery = {
    key: "battery",
    title: "battery [%]",
    digits: 1,
    held: "no",
    lines: byUav(episode.battery),
    isByUav: true,
  };
  return showsBattery ? [...charts, battery] : charts;
}

/** Smallest and largest value of the charts with the same key, with some room. */
export function rangeOf(charts) {
  const values = charts.flatMap((chart) => chart.lines.flatMap((line) => line.values));
  const low = values.reduce((least, value) => Math.min(least, value), 0);
  const high = values.reduce((most, value) => Math.max(most, value), low);
  const full = charts[0].key === "battery" ? [0, 100] : [low, high > low ? high : low + 1];
  const room = 0.06 * (full[1] - full[0]);
  return [full[0] < 0 ? full[0] - room : full[0] - room / 3, full[1] + room];
}

export class ChartView {
  /**
   * @param {HTMLElement} parent gets a figure, with the title and the legend as its caption
   * @param {import("page/episode").Episode} episode
   * @param {Chart} chart
   * @param {number[]} range of its values
   * @param {{player: import("page/player").Player, theme: import("page/theme").Theme}} page
   */
  constructor(parent, episode, chart, range, { player, theme }) {
    this.figure = document.createElement("figure");
    this.caption = document.createElement("figcaption");
    this.isCrowded = chart.lines.length > NAMED;
    this.caption.append(chart.title);
    this.figure.dataset.chart = chart.key;
    this.figure.append(this.caption);
    parent.append(this.figure);
    Object.assign(this, { episode, chart, player, theme });
    const data = [episode.time, ...chart.lines.map((line) => line.values)];
    this.plot = new uPlot(this.#options(range, player, theme), data, this.figure);
    this.future = document.createElement("div");
    this.future.className = "future";
    this.plot.over.append(this.future);
    this.plot.over.addEventListener("pointerdown", () => (this.dragged = false));
    this.plot.over.addEventListener("click", (event) => {
      if (!this.dragged) player.seek(this.plot.posToVal(event.offsetX, "x"));
    });
    this.plot.over.addEventListener("pointerleave", () => (this.hovered = false));
    this.plot.over.addEventListener("pointerenter", () => (this.hovered = true));
  }

  /** Mark a time, and show the numbers of its instant. */
  draw(now) {
    if (this.shown !== this.player.shown) {
      this.shown = this.player.shown;
      const [min, max] = this.shown;
      this.plot.batch(() => this.plot.setScale("x", { min, max }));
    }
    const width = this.plot.over.clientWidth;
    const at = Math.min(Math.max(this.plot.valToPos(now.time, "x"), 0), width);
    this.future.style.transform = `translateX(${at}px)`;
    if (!this.hovered && this.step !== now.step) this.plot.setLegend({ idx: now.step });
    this.step = this.hovered ? -1 : now.step;
  }

  /** Draw again in the present width and colours. */
  resize() {
    if (this.isCrowded)
      this.caption.querySelectorAll(".u-series").forEach((row, i) => {
        const isChosen = this.chart.isByUav && i - 1 === this.theme.chosen;
        row.style.display = isChosen ? "" : "none";
        if (isChosen) row.querySelector(".u-marker").style.background = this.chart.lines[i - 1].colour();
        if (i) this.plot.series[i].width = isChosen ? 2.5 : 1;
      });
    const width = this.figure.clientWidth;
    const height = this.#height();
    if (width && (width !== this.plot.width || height !== this.plot.height))
      this.plot.setSize({ width, height });
    else this.plot.redraw(false);
  }

  /** Height of a chart [px], which the style decides. */
  #height() {
    return Number(getComputedStyle(this.figure).getPropertyValue("--chart-height"));
  }

  /** Show the part of the time that a drag has chosen. */
  #select(plot) {
    const { left, width } = plot.select;
    if (!width) return;
    this.dragged = true;
    this.player.show(plot.posToVal(left, "x"), plot.posToVal(left + width, "x"));
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
  }

  #options(range, player, theme) {
    const axis = { stroke: () => theme.muted, font: FONT, ticks: { show: false } };
    const grid = { stroke: () => theme.line, width: 1 };
    const value = (_, number) => (number == null ? "" : number.toFixed(this.chart.digits));
    const align = ALIGN[this.chart.held];
    const series = this.chart.lines.map((line) => ({
      label: line.name,
      stroke: line.colour,
      width: this.isCrowded ? 1 : 1.6,
      value,
      points: { show: false },
      paths: align ? uPlot.paths.stepped({ align }) : uPlot.paths.linear(),
    }));
    return {
      width: this.figure.clientWidth || 300,
      height: this.#height(),
      padding: [6, MARGIN, 0, 0],
      legend: {
        mount: (_, legend) => this.caption.append(legend),
        markers: { width: 0, fill: (_, i) => this.chart.lines[i - 1]?.colour() },
      },
      cursor: {
        sync: { key: "time" },
        drag: { x: true, y: false, setScale: false, dist: 5 },
        bind: { dblclick: () => () => player.showAll() },
        points: { size: 5 },
        y: false,
      },
      hooks: { setSelect: [(plot) => this.#select(plot)] },
      scales: { x: { time: false, range: () => player.shown }, y: { range } },
      axes: [
        {
          ...axis,
          grid: { ...grid, show: false },
          size: 26,
          gap: 6,
          values: (_, ticks) => ticks.map((tick) => `${Number(tick.toFixed(6))} s`),
        },
        { ...axis, grid, size: GUTTER, gap: 4, space: 26 },
      ],
      series: [{ label: "time", value: (_, time) => (time == null ? "" : `${time} s`) }, ...series],
    };
  }
}
