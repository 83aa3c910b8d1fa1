/** Which part of the regions the maps show. All maps move together, in sizes of their regions. */

/** How near one can come, and how much a double click or a key brings one nearer. */
const [NEAREST, STEP] = [40, 2];

export class Zoom {
  /** How many times as large as the whole region things are drawn. */
  factor = 1;
  /** Shift of the middle of the map, east and north, in sizes of the region. */
  shift = [0, 0];

  /** What a map shows of limits west, south, east and north [m]. */
  limits([west, south, east, north]) {
    const size = Math.max(east - west, north - south);
    const middle = [(west + east) / 2 + this.shift[0] * size, (south + north) / 2 + this.shift[1] * size];
    const half = [(east - west) / (2 * this.factor), (north - south) / (2 * this.factor)];
    return [middle[0] - half[0], middle[1] - half[1], middle[0] + half[0], middle[1] + half[1]];
  }

  /** Come nearer by a factor; a place stays where it is, given from the region's middle, in sizes. */
  by(factor, place = this.shift) {
    const before = this.factor;
    this.factor = Math.min(Math.max(before * factor, 1), NEAREST);
    const share = before / this.factor;
    this.#show(place.map((value, axis) => value + (this.shift[axis] - value) * share));
  }

  /** Move the map, east and north, in sizes of the region. */
  move(east, north) {
    this.#show([this.shift[0] + east, this.shift[1] + north]);
  }

  /** Show the whole region, or come nearer to a place if one sees it. */
  toggle(place) {
    if (this.factor > 1) this.by(1 / NEAREST);
    else this.by(STEP * STEP, place);
  }

  /** Keys of the zoom. */
  get keys() {
    return { "+": () => this.by(STEP), "-": () => this.by(1 / STEP), 0: () => this.by(1 / NEAREST) };
  }

  /** Show another middle, so far as there is something to see. */
  #show(middle) {
    const most = 0.5 * (1 - 1 / this.factor);
    this.shift = middle.map((value) => Math.min(Math.max(value, -most), most));
  }
}

/**
 * Zoom a map with the wheel (while Ctrl or Cmd is held, so that the page can scroll), with two fingers, or by a
 * double click, and move it by dragging.
 * @param {import("page/map").MapView} map
 * @param {Zoom} zoom
 * @param {function(): void} changed
 */
export function listenToZoom(map, zoom, changed) {
  const { canvas } = map;
  const [west, south, east, north] = map.episode.limits;
  const size = Math.max(east - west, north - south);
  const relative = (pixel) => {
    const [x, y] = map.place(...pixel);
    return [(x - (west + east) / 2) / size, (y - (south + north) / 2) / size];
  };
  const fingers = new Map();
  const pixel = (event) => [event.offsetX, event.offsetY];
  const act = (action) => {
    action();
    changed();
  };
  canvas.addEventListener(
    "wheel",
    (event) => {
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      act(() => zoom.by(Math.exp(-0.004 * event.deltaY), relative(pixel(event))));
    },
    { passive: false },
  );
  canvas.addEventListener("dblclick", (event) => act(() => zoom.toggle(relative(pixel(event)))));
  canvas.addEventListener("pointerdown", (event) => fingers.set(event.pointerId, pixel(event)));
  for (const name of ["pointerup", "pointercancel", "pointerleave"]) {
    canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const other = [...fingers].find(([finger]) => finger !== event.pointerId)?.[1];
    const after = pixel(event);
    const [from, to] = [relative(before), relative(after)];
    fingers.set(event.pointerId, after);
    if (other) {
      act(() => zoom.by(distance(after, other) / Math.max(distance(before, other), 1), relative(other)));
    } else if (zoom.factor > 1) {
      act(() => zoom.move(from[0] - to[0], from[1] - to[1]));
    }
  });
}

function distance(one, other) {
  return Math.hypot(one[0] - other[0], one[1] - other[1]);
}
