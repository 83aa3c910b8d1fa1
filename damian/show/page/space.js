/** The region and the space above it, by three.js; marks are drawn on top, as on the map. */

import * as three from "libraries";
import { fitted } from "page/canvas";
import { Frame, length, roundLength } from "page/geography";
import { Ground } from "page/ground";
import { label } from "page/marks";
import { drawMarks } from "page/overlay";
import { SpaceUav } from "page/space_uav";

/** Heights are enlarged until the highest one is this share of the region's size, as in films. */
const SHARE = 0.3;
/** Height to which messages rise, as a share of the region's size. */
const RISE = 0.25;
/** Pixels of the ground's picture, in its larger direction. */
const PIXELS = 1536;
/** Where cameras begin, in the scene: east, up and south, so that they look to the north. */
const BEGIN = [0.14, 0.92, 0.86];
/** Angles that the camera sees, at least: in height and in width [deg]. */
const [SEEN_HIGH, SEEN_WIDE] = [46, 53];

/** Where the cameras of all views are, in sizes of their regions: they move together. */
const shared = { position: BEGIN, target: [0, -0.02, 0.08], moves: new Set() };

export class SpaceView {
  /**
   * @param {HTMLCanvasElement} canvas for the space
   * @param {HTMLCanvasElement} marks on top of it, for the marks
   * @param {import("page/episode").Episode} episode
   * @param {number} likely see Ground
   * @param {function(): void} changed to be called when the camera has moved
   * @throws {Error} without WebGL
   */
  constructor(canvas, marks, episode, likely, changed) {
    Object.assign(this, { canvas, marks, episode });
    this.renderer = new three.WebGLRenderer({ canvas, antialias: true, alpha: true });
    const [west, south, east, north] = episode.borders;
    this.middle = [(west + east) / 2, (south + north) / 2];
    this.size = Math.max(east - west, north - south);
    this.enlarged = episode.highest ? Math.max(1, roundLength((SHARE * this.size) / episode.highest)) : 1;
    this.scene = new three.Scene();
    const sun = new three.DirectionalLight("#ffffff", 2.2);
    sun.position.set(-1, 2, 1);
    this.scene.add(new three.AmbientLight("#ffffff", 1.4), sun);
    this.places = new Map();
    this.#addGround(likely);
    this.uavs = episode.position[0].map((_, uav) => new SpaceUav(this, uav));
    this.#addCamera(changed);
  }

  /** A place [m] in the scene, in sizes of the region: east is x, up is y, south is z. */
  point([east, north, up = 0]) {
    const [x, z] = [(east - this.middle[0]) / this.size, (this.middle[1] - north) / this.size];
    return [x, (up * this.enlarged) / this.size, z];
  }

  /** Draw what there is at a time. */
  draw(now, layers, theme) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.#resize(width, height);
    if (this.ground.paint(this.groundFrame, now.step, layers, theme)) this.texture.needsUpdate = true;
    for (const uav of this.uavs) uav.move(now, layers.has("truth"), theme);
    this.renderer.render(this.scene, this.camera);
    const context = fitted(this.marks, width, height);
    const pixel = (place) => this.pixel(place);
    const rise = (RISE * this.size) / this.enlarged;
    const { episode, places } = this;
    this.shown = drawMarks({ context, episode, now, layers, theme, pixel, darts: false, rise, places });
    this.#words(context, theme);
  }

  /** Pixel of a place east, north, up [m]; far outside for what is behind the camera. */
  pixel(place) {
    const { x, y, z } = new three.Vector3(...this.point(place)).project(this.camera);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    return z > 1 ? [-10 * width, -10 * height] : [((x + 1) / 2) * width, ((1 - y) / 2) * height];
  }

  /** Place [m] on the ground that a pixel shows, or undefined for the sky. */
  place(x, y) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const screen = new three.Vector2((2 * x) / width - 1, 1 - (2 * y) / height);
    const ray = new three.Raycaster();
    ray.setFromCamera(screen, this.camera);
    const hit = ray.ray.intersectPlane(new three.Plane(new three.Vector3(0, 1, 0)), new three.Vector3());
    return hit ? [hit.x * this.size + this.middle[0], this.middle[1] - hit.z * this.size] : undefined;
  }

  #addGround(likely) {
    const [west, south, east, north] = this.episode.limits;
    const [width, height] = [east - west, north - south];
    const [columns, rows] = [width, height].map((length) => Math.round((length * PIXELS) / this.size));
    this.groundFrame = new Frame(this.episode.limits, columns, rows);
    this.ground = new Ground(this.episode, likely);
    Object.assign(this.ground.canvas, { width: columns, height: rows });
    this.texture = new three.CanvasTexture(this.ground.canvas);
    this.texture.colorSpace = three.SRGBColorSpace;
    this.texture.anisotropy = 8;
    const material = new three.MeshBasicMaterial({ map: this.texture, transparent: true, depthWrite: false });
    const plane = new three.Mesh(new three.PlaneGeometry(width / this.size, height / this.size), material);
    plane.rotation.x = -Math.PI / 2;
    this.scene.add(plane);
  }

  #addCamera(changed) {
    this.camera = new three.PerspectiveCamera(SEEN_HIGH, 1, 0.01, 20);
    this.controls = new three.OrbitControls(this.camera, this.marks);
    this.controls.maxPolarAngle = 0.49 * Math.PI;
    this.controls.minDistance = 0.15;
    this.controls.maxDistance = 4;
    this.controls.zoomToCursor = true;
    const zoomed = (event) =>
      (this.controls.enableZoom = event.type !== "wheel" || event.ctrlKey || event.metaKey);
    for (const name of ["wheel", "pointerdown"]) this.marks.addEventListener(name, zoomed, { capture: true });
    this.#follow();
    shared.moves.add(() => this.#follow());
    this.controls.addEventListener("change", () => {
      if (this.following) return;
      shared.position = this.camera.position.toArray();
      shared.target = this.controls.target.toArray();
      for (const move of shared.moves) move();
      changed();
    });
  }

  /** Look from where all cameras are. */
  #follow() {
    this.following = true;
    this.camera.position.fromArray(shared.position);
    this.controls.target.fromArray(shared.target);
    this.controls.update();
    this.following = false;
  }

  #resize(width, height) {
    this.renderer.setPixelRatio(devicePixelRatio);
    const size = this.renderer.getSize(new three.Vector2());
    if (size.x !== width || size.y !== height) this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    const half = Math.tan((SEEN_WIDE * Math.PI) / 360) / this.camera.aspect;
    this.camera.fov = Math.max(SEEN_HIGH, (Math.atan(half) * 360) / Math.PI);
    this.camera.updateProjectionMatrix();
  }

  /** A length on the ground, the north, and how much heights are enlarged. */
  #words(context, theme) {
    const [west, south, east, north] = this.episode.borders;
    const metres = roundLength(0.3 * (east - west));
    const middle = (west + east) / 2;
    const below = south - 0.035 * this.size;
    const ends = [-metres / 2, metres / 2].map((shift) => this.pixel([middle + shift, below, 0]));
    context.strokeStyle = theme.muted;
    context.lineWidth = 1.5;
    context.beginPath();
    context.moveTo(...ends[0]);
    context.lineTo(...ends[1]);
    context.stroke();
    const [x, y] = [(ends[0][0] + ends[1][0]) / 2, (ends[0][1] + ends[1][1]) / 2];
    context.textAlign = "center";
    label(context, [x, y + 11], length(metres), theme.muted, theme);
    label(context, this.pixel([middle, north + 0.03 * this.size, 0]), "N", theme.muted, theme);
    context.textAlign = "left";
    const times = this.enlarged > 1 ? `${this.enlarged} times as large` : "to scale";
    if (this.episode.highest) label(context, [12, 14], `heights ${times}`, theme.muted, theme);
  }
}
