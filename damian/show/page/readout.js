/** The numbers of an instant as text: a line about the episode, and a table of its UAVs. */

import { plain } from "page/marks";

const [HOLLOW, FILLED] = ["–", "●"];
/** Units of the columns, by name. */
const UNITS = { east: "m", north: "m", up: "m", age: "s", battery: "%" };

export class Readout {
  /**
   * @param {HTMLElement} line for the line about the episode
   * @param {HTMLTableElement} table
   * @param {import("page/episode").Episode} episode
   * @param {function(number): void} choose what a click on a UAV does
   */
  constructor(line, table, episode, choose) {
    Object.assign(this, { line, episode });
    const isShown = { up: episode.highest > 0, spots: episode.hasSource };
    this.columns = [...Object.keys(UNITS), "spots"].filter((name) => isShown[name] ?? true);
    const head = table.createTHead().insertRow();
    for (const name of ["UAV", ...this.columns]) {
      const cell = document.createElement("th");
      cell.scope = "col";
      cell.textContent = UNITS[name] ? `${name} [${UNITS[name]}]` : name;
      head.append(cell);
    }
    const body = table.createTBody();
    this.rows = episode.ids.map((id, uav) => row(body, id, this.columns, () => choose(uav)));
  }

  /** Show the numbers of the instant before a time. */
  draw({ step, ended }, theme) {
    const { episode } = this;
    const key = [step, ended, theme.dark, theme.chosen].join();
    if (key === this.shown) return;
    this.shown = key;
    this.rows.forEach((cells, uav) => {
      const [east, north, up] = episode.position[step][uav];
      const numbers = { east, north, up, age: episode.age[step][uav], battery: episode.battery[step][uav] };
      for (const [name, cell] of cells) if (name in numbers) cell.textContent = written(numbers[name]);
      const spots = episode.spotted[step][uav];
      if (cells.has("spots")) {
        cells.get("spots").textContent = spots ? FILLED : HOLLOW;
        cells.get("spots").setAttribute("aria-label", spots ? "yes" : "no");
      }
      cells.get("UAV").style.setProperty("--uav", theme.uav(uav));
      cells.get("UAV").firstChild.setAttribute("aria-pressed", String(theme.chosen === uav));
      cells.get("age").classList.toggle("old", numbers.age > 0);
    });
    const spots = episode.spotters(step).length;
    const { wind } = episode.about;
    const which = episode.source?.[0].length > 1 ? "a" : "the";
    const arrow = wind && "↓↙←↖↑↗→↘"[Math.round(wind[1] / 45) % 8];
    const cells = [...(this.rows[theme.chosen] ?? [])].filter(([name]) => UNITS[name]);
    const told = cells.map(([name, cell]) => `${name} ${cell.textContent} ${UNITS[name]}`);
    const parts = [
      ["time", `${plain(episode.time[step])} s`],
      ["return", `return ${episode.returns[step].toFixed(2)}`],
      ["spots", episode.hasSource ? `${spots} of ${episode.nAgents} spot ${which} source` : ""],
      ["age", `mean age ${episode.meanAge[step].toFixed(1)} s`],
      ["mistaken", `believed places ${Math.round(episode.errors[step])} m off`],
      ["wind", wind ? `wind ${arrow} ${wind[0].toFixed(1)} m/s from ${Math.round(wind[1])}°` : ""],
      ["belief", episode.belief ? `belief ${episode.entropy(step).toFixed(1)} bit` : ""],
      ["chosen", told.length ? `${episode.names[theme.chosen]}: ${told.join(", ")}` : ""],
      ["ended", ended ? (episode.success ? "ended with success" : "ended") : ""],
    ];
    this.line.replaceChildren(
      ...parts
        .filter(([, text]) => text)
        .map(([name, text]) => {
          const part = document.createElement("span");
          part.dataset.shown = name;
          part.textContent = text;
          return part;
        }),
    );
  }
}

/** A number with one decimal, and a minus sign that is as wide as a digit. */
function written(value) {
  return value
    .toFixed(1)
    .replace(/^-0\.0$/, "0.0")
    .replace("-", "−");
}

/** A row of the table; returns its cells by name. */
function row(body, id, columns, choose) {
  const line = body.insertRow();
  const head = document.createElement("th");
  head.scope = "row";
  const button = document.createElement("button");
  Object.assign(button, { type: "button", textContent: id, title: `dim the others than ${id}` });
  button.addEventListener("click", choose);
  head.append(button);
  line.append(head);
  const cells = columns.map((name) => {
    const cell = line.insertCell();
    cell.dataset.shown = name;
    return [name, cell];
  });
  return new Map([["UAV", head], ...cells]);
}
