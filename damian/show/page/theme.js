/** The page's colours, from style.css and from the colours of the films, for light and dark screens. */

const DARK = matchMedia("(prefers-color-scheme: dark)");
/** Share of white that colours get on a dark screen. */
const LIGHTER = 0.32;
/** Share of paper that the colours of UAVs get while another one is chosen. */
const DIM = 0.72;
/** Colours of what is not late, late, and as late as it gets, as in films. */
const LATENESS = ["#a3b1bb", "#e08a00", "#7a0019"];

export class Theme {
  /** The UAV that the reader has chosen, whose colours alone are not dim; null if all are the same. */
  chosen = null;
  #listeners = [];

  /** @param {string[]} colours of the UAVs, as #rrggbb: the usual ones, and the same darkened */
  constructor(colours, nAgents) {
    this.colours = colours;
    this.few = colours.length / 2;
    /** Whether there are so many UAVs that only the chosen one is told apart. */
    this.many = nAgents > this.few;
    this.#read();
    DARK.addEventListener("change", () => {
      this.#read();
      this.#changed();
    });
  }

  /** Call a function when the screen turns dark or light, or another UAV is chosen. */
  onChange(listener) {
    this.#listeners.push(listener);
  }

  /** Choose a UAV, or none with null; the chosen one again: none. */
  choose(uav) {
    this.chosen = uav === this.chosen ? null : uav;
    this.#changed();
  }

  /** Whether a UAV has a name, a colour and a path of its own. */
  tells(number) {
    return !this.many || this.chosen === number;
  }

  /** Colour of a UAV. */
  uav(number) {
    return this.#dimmed(number, this.uavs[number % this.uavs.length]);
  }

  /** Colour of its marks: of one of many, that of how late is what is known of it, a share of the longest. */
  mark(number, late) {
    if (this.tells(number)) return this.uav(number);
    const colour = this.lateness(late);
    return this.chosen === null ? colour : mixed(colour, this.paper, DIM);
  }

  /** Colour of a lateness, a share of the longest. */
  lateness(share) {
    const at = Math.min(Math.max(share, 0), 1) * (this.lates.length - 1);
    const from = Math.min(Math.floor(at), this.lates.length - 2);
    return mixed(this.lates[from], this.lates[from + 1], at - from);
  }

  /** Colour of its texts: the darker one, on a dark screen the lighter one. */
  text(number) {
    return this.#dimmed(number, this.uavs[(this.dark ? 0 : this.few) + (number % this.few)]);
  }

  /** Colour of its lost messages. */
  lost(number) {
    return this.#dimmed(number, this.ink);
  }

  /** Colour of its mark's edge, which tells it from an earlier one of the same colour. */
  rim(number) {
    if (!this.tells(number)) return this.paper;
    return Math.floor(number / this.uavs.length) % 2 ? this.#dimmed(number, this.ink) : this.paper;
  }

  term(number) {
    return this.terms[number % this.terms.length];
  }

  #dimmed(number, colour) {
    if (!this.tells(number)) return this.other;
    return this.chosen === null || this.chosen === number ? colour : mixed(colour, this.paper, DIM);
  }

  #changed() {
    for (const listener of this.#listeners) listener();
  }

  #read() {
    const style = getComputedStyle(document.documentElement);
    const value = (name) => style.getPropertyValue(`--${name}`).trim();
    for (const name of [
      "paper",
      "land",
      "edge",
      "point",
      "ink",
      "muted",
      "line",
      "belief",
      "covered",
      "alarm",
      "other",
      "charge",
    ]) {
      this[name] = value(name);
    }
    this.dark = DARK.matches;
    this.terms = [0, 1, 2, 3, 4, 5].map((number) => value(`term-${number}`));
    const shown = (colour) => (this.dark ? mixed(colour, "#ffffff", LIGHTER) : colour);
    [this.uavs, this.lates] = [this.colours, LATENESS].map((colours) => colours.map(shown));
  }
}

/** A colour with an opacity in [0, 1]. */
export function faint(colour, opacity) {
  return `rgb(${channels(colour).join(" ")} / ${opacity})`;
}

/** A colour with a share of another one. */
function mixed(colour, other, share) {
  const parts = channels(other).map((to, i) => channels(colour)[i] * (1 - share) + to * share);
  return `#${parts.map((value) => Math.round(value).toString(16).padStart(2, "0")).join("")}`;
}

/** Red, green and blue of #rrggbb, in [0, 255]. */
function channels(colour) {
  return [1, 3, 5].map((at) => Number.parseInt(colour.slice(at, at + 2), 16));
}
