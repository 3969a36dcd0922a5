// Orbit controls of the camera, by pointer, touch or keys. The world is +Z up.

import { Matrix4, Vector3 } from "./three/three.module.min.js";

const UP = new Vector3(0, 0, 1);
const STEP = 0.08; // radians of an arrow key

export class Orbit {
  constructor(canvas, changed) {
    this.canvas = canvas;
    this.changed = changed;
    this.pose = new Matrix4();
    this.target = new Vector3();
    this.pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => this.#down(event));
    canvas.addEventListener("pointermove", (event) => this.#move(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.dolly(Math.exp(Math.max(-60, Math.min(60, event.deltaY)) * 0.004));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => this.#key(event));
  }

  take(pose, target) {
    this.pose.copy(pose);
    this.target.copy(target);
  }

  // Turns about the vertical, and about the camera's own right axis; never over the poles.
  rotate(aside, upwards) {
    const right = new Vector3().setFromMatrixColumn(this.pose, 0);
    const away = this.#eye().sub(this.target).normalize();
    const from_pole = Math.acos(Math.max(-1, Math.min(1, away.dot(UP))));
    const bounded = Math.max(0.03 - from_pole, Math.min(Math.PI - 0.03 - from_pole, upwards));
    this.#turn(new Matrix4().makeRotationAxis(right, bounded));
    this.#turn(new Matrix4().makeRotationAxis(UP, aside));
    this.changed();
  }

  pan(aside, upwards) {
    const far = this.#eye().distanceTo(this.target);
    const shift = new Vector3().setFromMatrixColumn(this.pose, 0).multiplyScalar(-aside * far);
    shift.addScaledVector(new Vector3().setFromMatrixColumn(this.pose, 1), upwards * far);
    this.target.add(shift);
    this.#place(this.#eye().add(shift));
    this.changed();
  }

  dolly(factor) {
    const away = this.#eye().sub(this.target).multiplyScalar(factor);
    if (away.length() < 1e-3 || away.length() > 900) return;
    this.#place(away.add(this.target));
    this.changed();
  }

  #eye() {
    return new Vector3().setFromMatrixPosition(this.pose);
  }

  #place(eye) {
    this.pose.setPosition(eye);
  }

  #turn(rotation) {
    const eye = this.#eye().sub(this.target).applyMatrix4(rotation).add(this.target);
    this.pose.setPosition(0, 0, 0).premultiply(rotation);
    this.#place(eye);
  }

  #down(event) {
    this.canvas.focus({ preventScroll: true });
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  #move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const size = this.canvas.clientHeight || 1;
    const [dx, dy] = [(now[0] - before[0]) / size, (now[1] - before[1]) / size];
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId);
    this.pointers.set(event.pointerId, now);
    if (others.length) {
      const other = others[0][1];
      const distance = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]) || 1;
      this.dolly(distance(before) / distance(now));
      this.pan(dx / 2, dy / 2);
    } else if (event.shiftKey || event.buttons & 6) {
      this.pan(dx, dy);
    } else {
      this.rotate(-dx * Math.PI, -dy * Math.PI);
    }
  }

  #key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    if (event.key in arrows) {
      const [x, y] = arrows[event.key];
      if (event.shiftKey) this.pan(-x * 0.05, -y * 0.05); else this.rotate(x * STEP, y * STEP);
    } else if (event.key === "+" || event.key === "=") {
      this.dolly(0.9);
    } else if (event.key === "-") {
      this.dolly(1 / 0.9);
    } else {
      return;
    }
    event.preventDefault();
  }
}
