/**
 * An episode as data, and what the views ask of it. docs/episodes.md says what its columns mean.
 *
 * N UAVs fly T steps; columns have T + 1 instants, that of the reset and the end of each step. Places are
 * metres east and north of the region's origin.
 */

/** Number of steps whose path is drawn behind a UAV. */
const TRAIL = 8;
/** Share of a step in which a UAV turns to where it flies next. */
const TURN = 0.2;
/** Number of steps for which a lost message is shown. */
const MOURNED = 2;

/**
 * What there is at a time: the latest instant, and how much of the step after it is over.
 * @typedef {{step: number, share: number, time: number, ended: boolean}} Now
 */
/**
 * A message: who sent it after which step, and when it arrives [s]; lost ones never do.
 * @typedef {{uav: number, step: number, sent: number, arrives: number, lost: boolean}} Message
 */

export class Episode {
  /** @param {object} file what an episode's file holds, and a title */
  constructor(file) {
    Object.assign(this, file);
    this.nAgents = this.position[0].length;
    const ids = this.about.uavs;
    /** The UAVs in a table, and in a text: their IDs if they are real ones, else their numbers. */
    this.ids = this.position[0].map((_, uav) => String(ids?.[uav] ?? uav));
    this.names = this.ids.map((id) => (ids ? id : `UAV ${id}`));
    this.last = this.time.length - 1;
    const mean = (row) => row.reduce((sum, each) => sum + each, 0) / row.length;
    this.end = this.time[this.last];
    this.dt = this.last ? this.time[1] - this.time[0] : 1;
    /** Outlines of the region: polygons, each a list of rings [[east, north], ...]. */
    this.polygons = this.region.type === "Polygon" ? [this.region.coordinates] : this.region.coordinates;
    /** West, south, east and north border of the region [m]. */
    this.borders = bordersOf(this.polygons.flat(2));
    /** Borders of what a view shows [m]: footprints are not cut, unless they are large. */
    this.limits = withMargin(this.borders, this.radius);
    this.usesBattery = this.battery.some((row) => row.some((level, uav) => level !== this.battery[0][uav]));
    /** Whether the task has a source, be it known or not. */
    this.hasSource = this.source === null || this.source[0].length > 0;
    this.highest = this.position.flat().reduce((most, place) => Math.max(most, place[2]), 0);
    this.messages = this.#messages();
    const longest = (rows) => rows.flat().reduce((most, each) => Math.max(most, each), 0);
    /** The longest delay, else the highest age: the end of the scale of what is late [s]. */
    this.longest = longest(this.delay) * this.dt || longest(this.age) || 1;
    /** Mean distance between where UAVs are and where the server believes them to be, at each instant [m]. */
    this.errors = this.believed.map((row, step) =>
      mean(row.map(([east, north], uav) => Math.hypot(east - this.position[step][uav][0], north - this.position[step][uav][1]))),
    );
    /** The instant at which the server is most mistaken, the last one of several. */
    this.worst = this.errors.findLastIndex((error) => error === Math.max(...this.errors));
    this.meanReward = this.reward.map(mean);
    this.meanAge = this.age.map(mean);
    const terms = Object.entries(this.reward_terms).map(([name, rows]) => [name, rows.map(mean)]);
    this.meanTerms = new Map(terms.filter(([, values]) => values.some((value) => value !== 0)));
    let sum = 0;
    this.returns = this.meanReward.map((reward) => (sum += reward));
  }

  /** @param {number} time [s] @returns {Now} */
  at(time) {
    const ended = time >= this.end;
    if (ended) return { step: this.last, share: 0, time: this.end, ended };
    let [step, after] = [0, this.last];
    while (after - step > 1) {
      const middle = (step + after) >> 1;
      if (this.time[middle] <= time) step = middle;
      else after = middle;
    }
    const share = (time - this.time[step]) / (this.time[step + 1] - this.time[step]);
    return { step, share, time, ended };
  }

  /** Where a UAV is: east, north, up [m]. Between two instants it is drawn on the straight way. */
  place(uav, { step, share }) {
    return between(this.position, step, share, uav);
  }

  /** Places of which the server hears at each instant: [[[east, north], ...], ...]. */
  get heard() {
    const heard = this.time.map((_, step) => (step ? [] : this.believed[0]));
    for (const { uav, step, lost } of this.messages)
      if (!lost) heard[step + this.delay[step][uav]]?.push(this.position[step][uav]);
    return heard;
  }

  /** How late is what the server knows of a UAV, as a share of the longest. */
  late(uav, { step }) {
    return this.age[step][uav] / this.longest;
  }

  /** Where a source is, if it is known: east, north [m]. */
  sourcePlace(number, { step, share }) {
    return between(this.source, step, share, number);
  }

  /** Heading of a UAV, clockwise from north [rad]. */
  heading(uav, { step, share }) {
    const before = this.track[step][uav];
    if (!share) return before;
    const [from, to] = [this.position[step][uav], this.position[step + 1][uav]];
    const [east, north] = [to[0] - from[0], to[1] - from[1]];
    const after = Math.hypot(east, north) > 0.01 ? Math.atan2(east, north) : before;
    const turn = ((((after - before) % (2 * Math.PI)) + 3 * Math.PI) % (2 * Math.PI)) - Math.PI;
    return before + turn * Math.min(share / TURN, 1);
  }

  /** The latest places of a UAV, the oldest first, up to where it is: [[east, north, up], ...]. */
  trail(uav, now) {
    const path = this.position
      .slice(Math.max(now.step - TRAIL, 0), now.step + 1)
      .map((places) => places[uav]);
    return [...path, this.place(uav, now)];
  }

  /** Messages that are under way at a time, or were lost shortly before. @returns {Message[]} */
  underWay({ time }) {
    return this.messages.filter(
      (message) =>
        message.sent <= time && time < (message.lost ? message.sent + MOURNED * this.dt : message.arrives),
    );
  }

  /** Numbers of the UAVs that spot the source at an instant. */
  spotters(step) {
    return this.spotted[step].flatMap((flag, uav) => (flag ? [uav] : []));
  }

  /** Entropy of the beliefs at an instant, summed over the sources [bit]. */
  entropy(step) {
    return this.belief[step].flat().reduce((sum, p) => (p > 0 ? sum - p * Math.log2(p) : sum), 0);
  }

  /** Edge of the belief's square cells [m]. */
  get cellEdge() {
    const east = [...new Set(this.cells.map((cell) => Math.round(cell[0] * 1000) / 1000))].sort(
      (a, b) => a - b,
    );
    const gaps = east.slice(1).map((value, i) => value - east[i]);
    return gaps.length ? Math.min(...gaps) : 1;
  }

  /** Every message that is late or lost or arrives at once, in the order of sending. @returns {Message[]} */
  #messages() {
    return this.sent.flatMap((row, step) =>
      row.flatMap((sent, uav) => {
        const delay = this.delay[step][uav];
        const time = this.time[step];
        return sent ? [{ uav, step, sent: time, arrives: time + delay * this.dt, lost: delay < 0 }] : [];
      }),
    );
  }
}

function bordersOf(corners) {
  const [east, north] = [corners.map((corner) => corner[0]), corners.map((corner) => corner[1])];
  const least = (values) => values.reduce((one, other) => Math.min(one, other));
  const most = (values) => values.reduce((one, other) => Math.max(one, other));
  return [least(east), least(north), most(east), most(north)];
}

function withMargin([west, south, east, north], radius) {
  const size = Math.max(east - west, north - south);
  const margin = Math.min(Math.max(0.06 * size, radius), 0.15 * size);
  return [west - margin, south - margin, east + margin, north + margin];
}

/** A row of a column between two instants; of one UAV if it is given. */
function between(column, step, share, uav) {
  const pick = (index) => (uav === undefined ? column[index] : column[index][uav]);
  if (!share) return pick(step);
  const after = pick(step + 1);
  return pick(step).map((value, axis) => value + share * (after[axis] - value));
}
