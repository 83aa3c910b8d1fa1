/** The page's colours, from style.css and from the colours of the films, for light and dark screens. */

const DARK = matchMedia("(prefers-color-scheme: dark)");
/** Share of white that colours get on a dark screen. */
const LIGHTER = 0.32;

export class Theme {
  /** @param {string[]} colours of the UAVs, as #rrggbb; a seventh UAV has the first one again */
  constructor(colours) {
    this.colours = colours;
    this.#read();
  }

  /** Call a function when the screen turns dark or light. */
  onChange(listener) {
    DARK.addEventListener("change", () => {
      this.#read();
      listener();
    });
  }

  /** Colour of a UAV, or of a reward's term. */
  uav(number) {
    return this.uavs[number % this.uavs.length];
  }

  term(number) {
    return this.terms[number % this.terms.length];
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
    ]) {
      this[name] = value(name);
    }
    this.dark = DARK.matches;
    this.terms = [0, 1, 2, 3, 4, 5].map((number) => value(`term-${number}`));
    this.uavs = this.colours.map((colour) => (this.dark ? lighter(colour) : colour));
  }
}

/** A colour with an opacity in [0, 1]. */
export function faint(colour, opacity) {
  return `rgb(${channels(colour).join(" ")} / ${opacity})`;
}

function lighter(colour) {
  const mixed = channels(colour).map((value) => Math.round(value + LIGHTER * (255 - value)));
  return `#${mixed.map((value) => value.toString(16).padStart(2, "0")).join("")}`;
}

/** Red, green and blue of #rrggbb, in [0, 255]. */
function channels(colour) {
  return [1, 3, 5].map((at) => Number.parseInt(colour.slice(at, at + 2), 16));
}
