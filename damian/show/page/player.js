/** The time line that all episodes of a page share: the time, whether it runs, and how fast. */

/** Steps in a second of playing. */
export const SPEEDS = [1, 2, 4, 8, 16, 32];

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
    if (this.playing && this.time >= this.end) this.time = 0;
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
    for (const listener of this.#listeners) listener();
    if (this.playing) this.changed();
  }
}
