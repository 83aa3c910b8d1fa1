/** A UAV in space: its body, its footprint, its latest path, and the line down to what it flies above. */

import * as three from "libraries";
import { DART } from "page/marks";

/** Length of a UAV as a share of the region's size. */
const SIZE = 0.022;
/** Widths of the footprint's edge, and of the path [px]. */
const [EDGE, PATH] = [1.4, 2.6];

export class SpaceUav {
  /**
   * @param {import("page/space").SpaceView} space
   * @param {number} uav its number
   */
  constructor(space, uav) {
    Object.assign(this, { space, uav });
    const radius = space.episode.radius / space.size;
    this.body = new three.Mesh(form(), new three.MeshLambertMaterial());
    const flat = new three.CircleGeometry(radius, 64).rotateX(-Math.PI / 2);
    const seeThrough = { transparent: true, depthWrite: false };
    this.footprint = new three.Mesh(flat, new three.MeshBasicMaterial(seeThrough));
    this.footprint.renderOrder = 1;
    this.edge = lines(EDGE);
    draw(this.edge, pairs(circle(radius)), () => new three.Color("#ffffff"));
    this.path = lines(PATH);
    this.parts = [this.body, this.footprint, this.edge, this.path];
    space.scene.add(...this.parts);
  }

  /** Go to where the UAV is at a time, or vanish. */
  move(now, visible, theme) {
    for (const part of this.parts) part.visible = visible;
    if (!visible) return;
    const { episode } = this.space;
    const place = episode.place(this.uav, now);
    const [above, below] = [this.space.point(place), this.space.point([place[0], place[1], 0])];
    const spotted = episode.spotted[now.step][this.uav];
    const tells = theme.tells(this.uav);
    this.edge.visible = tells || Boolean(spotted);
    this.body.scale.setScalar(tells ? 1 : 0.7);
    const [colour, land] = [new three.Color(theme.uav(this.uav)), new three.Color(theme.land)];
    this.body.material.color = colour;
    this.body.position.set(...above);
    this.body.rotation.y = -episode.heading(this.uav, now);
    this.footprint.material.color = colour;
    this.footprint.material.opacity = spotted ? 0.3 : 0.09;
    this.footprint.position.set(...below);
    this.edge.material.color = colour.clone().lerp(land, spotted ? 0 : 0.5);
    this.edge.position.set(...below);
    const trail = tells ? episode.trail(this.uav, now) : [];
    const path = pairs(trail.map((each) => this.space.point(each)));
    const faded = (part) => (part < path.length ? 0.7 * (1 - part / path.length) : 0.35);
    draw(this.path, [...path, [above, below]], (part) => colour.clone().lerp(land, faded(part)));
  }
}

/** The body, as the mark of the map, and solid. */
function form() {
  const shape = new three.Shape(DART.map(([east, north]) => new three.Vector2(east * SIZE, north * SIZE)));
  const bevel = { bevelSize: 0.08 * SIZE, bevelThickness: 0.08 * SIZE, bevelSegments: 2 };
  return new three.ExtrudeGeometry(shape, { depth: 0.3 * SIZE, ...bevel }).rotateX(-Math.PI / 2);
}

function lines(linewidth) {
  const material = { linewidth, vertexColors: true, transparent: true, depthWrite: false };
  const made = new three.LineSegments2(new three.LineSegmentsGeometry(), new three.LineMaterial(material));
  made.frustumCulled = false;
  made.renderOrder = 2;
  return made;
}

/** Corners of a circle on the ground, in the scene. */
function circle(radius) {
  const angles = Array.from({ length: 65 }, (_, i) => (i * Math.PI) / 32);
  return angles.map((angle) => [radius * Math.cos(angle), 0, radius * Math.sin(angle)]);
}

function pairs(points) {
  return points.slice(1).map((point, i) => [points[i], point]);
}

/** Give lines their ends [[from, to], ...], and each the colour that a function has for its number. */
function draw(made, ends, colourOf) {
  const colours = ends.map((_, part) => colourOf(part).toArray());
  made.geometry.dispose();
  made.geometry = new three.LineSegmentsGeometry();
  made.geometry.setPositions(ends.flat(2));
  made.geometry.setColors(colours.flatMap((colour) => [...colour, ...colour]));
}
