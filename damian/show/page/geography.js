/** Where things are: from metres to pixels, to latitude and longitude, and the length of a scale bar. */

/** Mean radius of the Earth [m], that of damian/world/regions/geodesy.py. */
const EARTH_RADIUS = 6371008.8;

/**
 * A view from above: pixels of a canvas for places in metres.
 */
export class Frame {
  /**
   * Fits limits into a canvas, with equal scales in both directions, in its middle.
   * @param {number[]} limits west, south, east, north [m]
   * @param {number} width of the canvas [px]
   * @param {number} height of the canvas [px]
   */
  constructor([west, south, east, north], width, height) {
    Object.assign(this, { width, height });
    this.scale = Math.min(width / (east - west), height / (north - south));
    this.left = width / 2 - ((west + east) / 2) * this.scale;
    this.top = height / 2 + ((south + north) / 2) * this.scale;
  }

  /** Pixel of a place [m]. */
  pixel([east, north]) {
    return [this.left + east * this.scale, this.top - north * this.scale];
  }

  /** Place [m] of a pixel. */
  place(x, y) {
    return [(x - this.left) / this.scale, (this.top - y) / this.scale];
  }
}

/**
 * Latitude and longitude [deg] of a place: inverse azimuthal equidistant projection on a sphere.
 * @param {number[]} place east, north [m]
 * @param {number[]} origin latitude and longitude of (0, 0) [deg]
 */
export function latLon([x, y], origin) {
  const radians = Math.PI / 180;
  const arc = Math.hypot(x, y) / EARTH_RADIUS;
  const bearing = Math.atan2(x, y);
  const latitude0 = origin[0] * radians;
  const east = Math.sin(arc) * Math.sin(bearing);
  const north = Math.sin(arc) * Math.cos(bearing);
  const out = Math.cos(arc) * Math.cos(latitude0) - north * Math.sin(latitude0);
  const up = Math.cos(arc) * Math.sin(latitude0) + north * Math.cos(latitude0);
  const longitude = Math.atan2(east, out) / radians + origin[1];
  const wrapped = longitude - 360 * Math.floor((longitude + 180) / 360);
  return [Math.atan2(up, Math.hypot(out, east)) / radians, wrapped];
}

/** A place in words: latitude and longitude if the region lies on Earth, else metres. */
export function spoken(place, origin) {
  if (origin) {
    const [latitude, longitude] = latLon(place, origin);
    const north = `${Math.abs(latitude).toFixed(5)}° ${latitude < 0 ? "S" : "N"}`;
    return `${north}, ${Math.abs(longitude).toFixed(5)}° ${longitude < 0 ? "W" : "E"}`;
  }
  return `east ${metres(place[0])}, north ${metres(place[1])}`;
}

/** A round length [m] that is at most as long as another one: 1, 2 or 5 times a power of ten. */
export function roundLength(longest) {
  const power = 10 ** Math.floor(Math.log10(longest));
  return [5, 2, 1].find((factor) => factor * power <= longest) * power;
}

/** A length [m] in words. */
export function length(value) {
  return value >= 1000 ? `${value / 1000} km` : `${value} m`;
}

function metres(value) {
  return `${value.toFixed(0).replace("-0", "0").replace("-", "−")} m`;
}
