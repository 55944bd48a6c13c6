"use strict";
// Draws the people in 3D on a 2D canvas: faces sorted by depth, no GPU. Metres; z is up, the floor is at z = 0.

/** The numbers of an array that Python packed: a Float32Array with its shape. */
function unpack(packed) {
  const bytes = Uint8Array.from(atob(packed.data), (c) => c.charCodeAt(0));
  const values = new Float32Array(bytes.buffer);
  values.shape = packed.shape;
  return values;
}

/** "#rrggbb" as three numbers. */
function rgbOf(text) {
  return [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16));
}

class Viewer {
  constructor(canvas, data) {
    this.canvas = canvas;
    this.scene = data.scene;
    this.colors = data.colors;
    this.names = data.joints;
    this.withoutPose = data.withoutPose;
    this.cameras = data.scene.cameras.map((c) => ({ name: c.name, points: unpack(c.points) }));
    this.people = data.people.map((person, n) => ({
      status: person.status,
      joints: unpack(person.positions),
      transforms: unpack(person.transforms),
      sigma: person.sigma && unpack(person.sigma),
      solids: person.solids.map((solid) => {
        const rings = unpack(solid.rings);
        const color = rgbOf(n ? data.colors.people[n] : data.colors.segments[person.segments[solid.segment]]);
        return { segment: solid.segment, points: rings, faces: facesOf(rings.shape[0], data.scene.around), color };
      }),
    }));
    this.shown = { body: true, bones: true, cameras: true };
    this.frame = 0;
    this.reset();
    this.listen();
    new ResizeObserver(() => this.draw()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  reset() {
    this.turn = this.facing() + 0.6;
    this.lift = 0.22;
    this.distance = Math.max(2.1 * this.scene.radius, 2.7);
    this.draw();
  }

  /** The angle from which the first person is seen in front, in the middle of the recording. */
  facing() {
    const { joints } = this.people[0];
    const count = joints.shape[1], middle = Math.floor(joints.shape[0] / 2) * count;
    const of = (name, axis) => joints[3 * (middle + this.names.indexOf(name)) + axis];
    const left = [0, 1].map((axis) => of("hip_l", axis) - of("hip_r", axis));
    const turn = Math.atan2(left[1], left[0]);
    return isFinite(turn) ? turn : 0;
  }

  listen() {
    const canvas = this.canvas;
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons) return;
      this.turn -= event.movementX * 0.01;
      this.lift = Math.min(1.5, Math.max(-0.2, this.lift + event.movementY * 0.008));
      this.draw();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const nearest = 0.5, farthest = 20 * this.scene.radius;
      this.distance = Math.min(farthest, Math.max(nearest, this.distance * Math.exp(event.deltaY * 0.001)));
      this.draw();
    }, { passive: false });
    canvas.addEventListener("dblclick", () => this.reset());
  }

  show(frame) {
    this.frame = frame;
    this.draw();
  }

  /** A point of the scene as pixels and depth, or null behind the eye. */
  place(x, y, z) {
    const e = this.eye;
    const right = e.cos * x + e.sin * y;
    const ahead = -e.sin * x + e.cos * y;
    const up = z - this.scene.height;
    const depth = this.distance + ahead * e.cosLift - up * e.sinLift;
    if (depth < 0.05) return null;
    const scale = e.focal / depth;
    return [e.x + scale * right, e.y - scale * (up * e.cosLift + ahead * e.sinLift), depth];
  }

  draw() {
    const { canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width || !height) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const pen = this.pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    const style = getComputedStyle(document.documentElement);
    const color = (name) => style.getPropertyValue(name).trim();
    pen.fillStyle = color("--stage");
    pen.fillRect(0, 0, width, height);
    this.eye = {
      cos: Math.cos(this.turn), sin: Math.sin(this.turn), cosLift: Math.cos(this.lift), sinLift: Math.sin(this.lift),
      focal: 1.25 * height, x: width / 2, y: height / 2,
    };
    this.drawFloor(color("--floor"));
    if (this.shown.cameras) this.drawCameras(color("--wire"));
    if (this.shown.body) this.drawBodies();
    if (this.shown.bones) this.people.forEach((person) => this.drawSkeleton(person));
  }

  lost(person) {
    return this.withoutPose.includes(person.status[this.frame]);
  }

  line(a, b) {
    const from = this.place(...a), to = this.place(...b);
    if (!from || !to) return;
    this.pen.moveTo(from[0], from[1]);
    this.pen.lineTo(to[0], to[1]);
  }

  drawFloor(color) {
    const reach = Math.max(2, Math.ceil(this.scene.radius * 1.5)), step = 0.5;
    this.pen.beginPath();
    for (let k = -reach; k <= reach + 1e-9; k += step) {
      for (let j = -reach; j < reach - 1e-9; j += step) { // in pieces, because one end may be behind the camera
        this.line([k, j, 0], [k, j + step, 0]);
        this.line([j, k, 0], [j + step, k, 0]);
      }
    }
    this.pen.strokeStyle = color;
    this.pen.lineWidth = 1;
    this.pen.stroke();
  }

  drawCameras(color) {
    const { pen } = this;
    pen.strokeStyle = pen.fillStyle = color;
    pen.lineWidth = 1.2;
    pen.font = "12px system-ui, sans-serif";
    for (const camera of this.cameras) {
      const corner = (k) => Array.from(camera.points.subarray(3 * k, 3 * k + 3));
      pen.beginPath();
      for (let k = 1; k <= 4; k++) {
        this.line(corner(0), corner(k));
        this.line(corner(k), corner(k % 4 + 1));
      }
      pen.stroke();
      const center = this.place(...corner(0));
      if (center) pen.fillText(camera.name, center[0] + 8, center[1] - 8);
    }
  }

  drawBodies() {
    const faces = this.people.flatMap((person) => this.facesOfBody(person));
    faces.sort((a, b) => b.depth - a.depth);
    const { pen } = this;
    pen.lineWidth = 0.7;
    for (const { corners, base, shade } of faces) {
      pen.fillStyle = pen.strokeStyle = `rgb(${base.map((value) => Math.min(255, Math.round(value * shade))).join(",")})`;
      pen.beginPath();
      corners.forEach((p, k) => (k ? pen.lineTo(p[0], p[1]) : pen.moveTo(p[0], p[1])));
      pen.closePath();
      pen.fill();
      pen.stroke(); // closes gaps between neighbouring faces
    }
  }

  facesOfBody(person) {
    const T = person.transforms, perFrame = T.shape[1] * 12, lost = this.lost(person), faces = [];
    const light = 1 / Math.hypot(0.35, 0.4, 0.85);
    for (const solid of person.solids) {
      const m = this.frame * perFrame + solid.segment * 12;
      const points = solid.points, count = points.length / 3;
      const world = new Float32Array(points.length), seen = new Array(count);
      for (let i = 0; i < count; i++) {
        const x = points[3 * i], y = points[3 * i + 1], z = points[3 * i + 2];
        for (let r = 0; r < 3; r++) {
          world[3 * i + r] = T[m + 4 * r] * x + T[m + 4 * r + 1] * y + T[m + 4 * r + 2] * z + T[m + 4 * r + 3];
        }
        seen[i] = this.place(world[3 * i], world[3 * i + 1], world[3 * i + 2]);
      }
      if (seen.some((p) => !p || !isFinite(p[0]))) continue;
      const base = lost ? rgbOf(this.colors.lostBody) : solid.color;
      for (const face of solid.faces) {
        const [a, b, c, d] = face.map((i) => seen[i]);
        const area = (c[0] - a[0]) * (d[1] - b[1]) - (c[1] - a[1]) * (d[0] - b[0]);
        if (area >= 0) continue; // a back face: the screen's y axis points down
        const [i, j, k, l] = face.map((n) => 3 * n);
        const u = [0, 1, 2].map((r) => world[k + r] - world[i + r]), v = [0, 1, 2].map((r) => world[l + r] - world[j + r]);
        const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        // the light comes from behind the viewer
        const along = (n[0] * (0.35 * this.eye.cos + 0.4 * this.eye.sin) + n[1] * (0.35 * this.eye.sin - 0.4 * this.eye.cos)
          + n[2] * 0.85) * light / Math.max(Math.hypot(...n), 1e-12);
        faces.push({ depth: a[2] + b[2] + c[2] + d[2], corners: [a, b, c, d], base, shade: 0.76 + 0.32 * along });
      }
    }
    return faces;
  }

  drawSkeleton(person) {
    const { pen } = this, { joints } = person, count = joints.shape[1], lost = this.lost(person), at = [];
    for (let j = 0; j < count; j++) {
      const p = 3 * (this.frame * count + j);
      const point = this.place(joints[p], joints[p + 1], joints[p + 2]);
      at.push(point && isFinite(point[0]) ? point : null);
    }
    const plain = lost ? this.colors.lostBody : this.colors.bone;
    for (const [width, color] of [[4.5, "#141414"], [1.8, plain]]) {
      pen.beginPath();
      for (const [a, b] of this.scene.bones) {
        if (!at[a] || !at[b]) continue;
        pen.moveTo(at[a][0], at[a][1]);
        pen.lineTo(at[b][0], at[b][1]);
      }
      pen.strokeStyle = color;
      pen.lineWidth = width;
      pen.lineCap = "round";
      pen.stroke();
    }
    at.forEach((point, j) => {
      if (!point) return;
      const sigma = person.sigma ? person.sigma[this.frame * count + j] : null;
      pen.beginPath();
      pen.arc(point[0], point[1], 4.2, 0, 2 * Math.PI);
      pen.fillStyle = lost || sigma === null ? plain : Number.isNaN(sigma) ? "#141414" : sigmaColor(this.colors, sigma);
      pen.fill();
      pen.strokeStyle = sigma !== null && Number.isNaN(sigma) ? plain : "#141414";
      pen.lineWidth = 1.4;
      pen.stroke();
    });
  }
}

/** Corners of a solid's faces as indices of the points of its circles, the same way round seen from outside. */
function facesOf(rings, around) {
  const faces = [];
  for (let r = 0; r + 1 < rings; r++) {
    for (let k = 0; k < around; k++) {
      const next = (k + 1) % around;
      faces.push([r * around + k, r * around + next, (r + 1) * around + next, (r + 1) * around + k]);
    }
  }
  const last = (rings - 1) * around;
  for (let k = 1; k + 2 < around; k += 2) {
    faces.push([k + 2, k + 1, k, 0], [last, last + k, last + k + 1, last + k + 2]);
  }
  return faces;
}

/** The colour of a joint with a standard deviation, metres. */
function sigmaColor(colors, sigma) {
  const stops = colors.sigma, place = Math.min(Math.max(sigma / colors.sigmaMost, 0), 1) * (stops.length - 1);
  const low = Math.min(Math.floor(place), stops.length - 2), share = place - low;
  return `rgb(${[0, 1, 2].map((c) => Math.round(stops[low][c] + share * (stops[low + 1][c] - stops[low][c]))).join(",")})`;
}
