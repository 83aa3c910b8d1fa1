/** The numbers of an instant as text: a line about the episode, and a table of its UAVs. */

import { plain } from "page/marks";

const [HOLLOW, FILLED] = ["–", "●"];
const COLUMNS = ["UAV", "east", "north", "up", "age", "battery", "spots"];

export class Readout {
  /**
   * @param {HTMLElement} line for the line about the episode
   * @param {HTMLTableElement} table
   * @param {import("page/episode").Episode} episode
   */
  constructor(line, table, episode) {
    Object.assign(this, { line, episode });
    const units = { east: "m", north: "m", up: "m", age: "s", battery: "%" };
    const head = table.createTHead().insertRow();
    for (const name of COLUMNS) {
      const cell = document.createElement("th");
      cell.scope = "col";
      cell.textContent = units[name] ? `${name} [${units[name]}]` : name;
      head.append(cell);
    }
    const body = table.createTBody();
    this.rows = episode.position[0].map((_, uav) => row(body, uav));
  }

  /** Show the numbers of the instant before a time. */
  draw({ step, ended }, theme) {
    const { episode } = this;
    const spots = episode.spotters(step).length;
    const parts = [
      ["time", `${plain(episode.time[step])} s`],
      ["return", `return ${episode.returns[step].toFixed(2)}`],
      ["spots", `${spots} of ${episode.nAgents} spot the source`],
      ["age", `mean age ${episode.meanAge[step].toFixed(1)} s`],
      ["ended", ended ? (episode.success ? "ended with success" : "ended") : ""],
    ];
    this.line.replaceChildren(...parts.filter(([, text]) => text).map(([name, text]) => {
      const part = document.createElement("span");
      part.dataset.shown = name;
      part.textContent = text;
      return part;
    }));
    this.rows.forEach((cells, uav) => {
      const [east, north, up] = episode.position[step][uav];
      const numbers = [east, north, up, episode.age[step][uav], episode.battery[step][uav]].map((value) => value.toFixed(1));
      numbers.forEach((text, i) => (cells[i + 1].textContent = text.replace("-", "−")));
      cells[6].textContent = episode.spotted[step][uav] ? FILLED : HOLLOW;
      cells[6].setAttribute("aria-label", episode.spotted[step][uav] ? "yes" : "no");
      cells[0].style.setProperty("--uav", theme.uav(uav));
      cells[0].parentElement.classList.toggle("old", episode.age[step][uav] > 0);
    });
  }
}

/** A row of the table; returns its cells. */
function row(body, uav) {
  const line = body.insertRow();
  const head = document.createElement("th");
  head.scope = "row";
  head.textContent = uav;
  line.append(head);
  return [head, ...COLUMNS.slice(1).map(() => line.insertCell())];
}
