/** The time line that all episodes of a page share: the time, whether it runs, and how fast. */

/** Steps in a second of playing. */
export const SPEEDS = [1, 2, 4, 8, 16, 32];
/** Least number of steps that rows and charts show. */
const LEAST = 5;

export class Player {
  /** @type {number} time [s] */
  time = 0;
  playing = false;
  speed = 4;
  #listeners = [];
  #asked = false;
  #before = 0;

  /** @param {import("page/episode").Episode[]} episodes */
  constructor(episodes) {
    this.instants = [...new Set(episodes.flatMap((episode) => episode.time))].sort((a, b) => a - b);
    this.end = this.instants.at(-1);
    this.dt = Math.min(...episodes.map((episode) => episode.dt));
    /** Length of all of the time [s]. */
    this.span = Math.max(this.end, this.dt);
    /** First and last time that rows and charts show [s]. */
    this.shown = [0, this.span];
    /** First and last time that a drag is about to choose [s], or null. */
    this.chosen = null;
  }

  get isZoomed() {
    return this.shown[1] - this.shown[0] < this.span;
  }

  /** Show a part of the time, which has at least a few steps, in rows and charts. */
  show(one, other) {
    const least = Math.min(LEAST * this.dt, this.span);
    const width = Math.min(Math.max(Math.abs(other - one), least), this.span);
    const begin = Math.min(Math.max((one + other - width) / 2, 0), this.span - width);
    this.shown = [begin, begin + width];
    if (this.time < begin || this.time > begin + width)
      this.time = this.instants.find((instant) => instant >= begin);
    this.changed();
  }

  showAll() {
    this.show(0, this.span);
  }

  /** Show a part of the time about the present, so many times as short. */
  nearer(factor) {
    const half = (this.shown[1] - this.shown[0]) / factor / 2;
    this.show(this.time - half, this.time + half);
  }

  /** Say what a drag is about to choose, or null. */
  choose(one, other) {
    this.chosen = one === null ? null : [Math.min(one, other), Math.max(one, other)];
    this.changed();
  }

  /** Call a function after each change, at most once for each picture of the screen. */
  onChange(listener) {
    this.#listeners.push(listener);
  }

  /** Say that something has changed, such as a layer. */
  changed() {
    if (this.#asked) return;
    this.#asked = true;
    requestAnimationFrame((clock) => this.#tick(clock));
  }

  /** Go to the instant nearest to a time [s]. */
  seek(time) {
    const nearer = (best, each) => (Math.abs(each - time) < Math.abs(best - time) ? each : best);
    this.time = this.instants.reduce(nearer);
    this.changed();
  }

  /** Open the page at a time [s]; playing begins at 0 nevertheless. */
  open(time) {
    this.time = this.opening = time;
  }

  /** Go so many instants on, or back. */
  step(count) {
    this.playing = false;
    const passed = this.instants.findLastIndex((instant) => instant <= this.time);
    const amid = this.time > this.instants[passed] && count < 0 ? 1 : 0;
    const index = Math.min(Math.max(passed + amid + count, 0), this.instants.length - 1);
    this.seek(this.instants[index]);
  }

  toggle() {
    this.playing = !this.playing;
    if (this.playing && (this.time >= this.end || this.time === this.opening)) this.time = 0;
    this.opening = null;
    this.#before = performance.now();
    this.changed();
  }

  /** Take the next speed of the list, or the one before. */
  hurry(direction) {
    const index = SPEEDS.indexOf(this.speed) + direction;
    this.speed = SPEEDS[Math.min(Math.max(index, 0), SPEEDS.length - 1)];
    this.changed();
  }

  #tick(clock) {
    this.#asked = false;
    if (this.playing) {
      const passed = Math.max(clock - this.#before, 0) / 1000;
      this.#before = clock;
      this.time = Math.min(this.time + passed * this.speed * this.dt, this.end);
      this.playing = this.time < this.end;
    }
    const [from, to] = this.shown;
    if (this.time < from || this.time > to) this.show(this.time, this.time + to - from);
    for (const listener of this.#listeners) listener();
    if (this.playing) this.changed();
  }
}
