"use strict";
// Curves over time as SVG.

const SVG = "http://www.w3.org/2000/svg";

function element(name, attributes = {}, text = "") {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return made;
}

/** About `count` round numbers between two. */
function ticks(low, high, count) {
  const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((n) => n * power).find((n) => n >= raw);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
  return found;
}

/** A number with two digits or three. */
function short(value) {
  if (!isFinite(value)) return "–";
  const size = Math.abs(value);
  const text = size >= 100 ? value.toFixed(0) : size >= 10 ? value.toFixed(1) : size < 1e-6 ? "0" : value.toPrecision(2);
  return String(+text).replace("-", "−");
}

/** A number of a table, where all have the same digits after the point. */
function listed(value) {
  return isFinite(value) ? value.toFixed(1).replace("-", "−") : "–";
}

class Chart {
  /**
   * options: title, unit, lines [{name, color, values, sigma}], time, lost (flags), height, width, wraps (at ±180),
   * zero (begin at 0), least (range), digits, hint, seek(row).
   */
  constructor(parent, options) {
    Object.assign(this, { width: 400, height: 140 }, options);
    const figure = document.createElement("figure");
    figure.className = "chart";
    const caption = document.createElement("figcaption");
    const title = document.createElement("b");
    title.textContent = this.title;
    if (this.hint) title.title = this.hint;
    this.value = document.createElement("span");
    this.value.className = "muted";
    caption.append(title, this.value);
    this.svg = element("svg", { viewBox: `0 0 ${this.width} ${this.height}`, role: "img", "aria-label": `${this.title} over time, ${this.unit}` });
    figure.append(caption, this.svg);
    parent.append(figure);
    this.left = 36;
    this.right = this.width - 6;
    this.top = 6;
    this.bottom = this.height - 18;
    this.draw();
    this.svg.addEventListener("pointerdown", (event) => this.pick(event));
    this.svg.addEventListener("pointermove", (event) => event.buttons && this.pick(event));
  }

  get span() {
    const first = this.time[0], last = this.time[this.time.length - 1];
    return [first, last > first ? last : first + 1];
  }

  x(seconds) {
    const [first, last] = this.span;
    return this.left + (seconds - first) / (last - first) * (this.right - this.left);
  }

  y(value) {
    return this.bottom - (value - this.low) / (this.high - this.low) * (this.bottom - this.top);
  }

  pick(event) {
    const box = this.svg.getBoundingClientRect();
    const [first, last] = this.span;
    const share = ((event.clientX - box.left) / box.width * this.width - this.left) / (this.right - this.left);
    const seconds = first + share * (last - first);
    let best = 0;
    this.time.forEach((t, row) => { if (Math.abs(t - seconds) < Math.abs(this.time[best] - seconds)) best = row; });
    this.seek(best);
  }

  draw() {
    this.range();
    const { svg } = this;
    // lost frames first, so that they lie behind the curves
    const half = (this.span[1] - this.span[0]) / Math.max(this.time.length - 1, 1) / 2;
    this.lost.forEach((flag, row) => {
      if (!flag) return;
      const from = Math.max(this.x(this.time[row] - half), this.left), to = Math.min(this.x(this.time[row] + half), this.right);
      svg.append(element("rect", { class: "lost", x: from, y: this.top, width: Math.max(to - from, 1), height: this.bottom - this.top }));
    });
    for (const value of ticks(this.low, this.high, 4)) {
      const y = this.y(value);
      svg.append(element("line", { class: "grid", x1: this.left, x2: this.right, y1: y, y2: y }));
      svg.append(element("text", { x: this.left - 5, y: y + 4, "text-anchor": "end" }, short(value)));
    }
    svg.append(element("line", { class: "axis", x1: this.left, x2: this.right, y1: this.bottom, y2: this.bottom }));
    const [first, last] = this.span, marks = ticks(first, last, this.width / 80);
    marks.forEach((seconds, k) => {
      const text = k === marks.length - 1 ? `${short(seconds)} s` : short(seconds);
      const anchor = this.x(seconds) > this.right - 12 ? "end" : "middle";
      svg.append(element("text", { x: this.x(seconds), y: this.height - 4, "text-anchor": anchor }, text));
    });
    for (const line of this.lines) {
      if (line.sigma) svg.append(element("path", { class: "band", d: this.band(line), fill: line.color }));
    }
    for (const line of this.lines) {
      svg.append(element("path", { class: "line", d: this.path(line.values), stroke: line.color, "stroke-dasharray": line.dash || "none" }));
    }
    this.cursor = element("line", { class: "cursor", y1: this.top, y2: this.bottom });
    svg.append(this.cursor);
  }

  /** From the values that are shown; lost frames may be anywhere and do not count where there are others. */
  range() {
    const known = (row) => !this.lost[row] || this.lost.every(Boolean);
    let low = Infinity, high = -Infinity;
    for (const { values, sigma } of this.lines) {
      values.forEach((value, row) => {
        if (!isFinite(value) || !known(row)) return;
        const about = sigma && isFinite(sigma[row]) ? sigma[row] : 0;
        low = Math.min(low, value - about);
        high = Math.max(high, value + about);
      });
    }
    if (low > high) [low, high] = [0, 1];
    if (this.zero) low = 0;
    const least = this.least || 1e-6, room = Math.max((high - low) * 0.06, (least - (high - low)) / 2, 0);
    this.low = this.zero ? 0 : low - room;
    this.high = high + room;
  }

  path(values) {
    let text = "", before = NaN;
    values.forEach((value, row) => {
      if (isFinite(value)) {
        const jump = !isFinite(before) || (this.wraps && Math.abs(value - before) > 180);
        const y = Math.min(Math.max(this.y(value), this.top - 3), this.bottom + 3);
        text += `${jump ? "M" : "L"}${this.x(this.time[row]).toFixed(1)} ${y.toFixed(1)}`;
      }
      before = value;
    });
    return text;
  }

  /** An area for each run of known values. */
  band({ values, sigma }) {
    let text = "", upper = [], lower = [];
    const end = () => {
      if (upper.length) text += `M${[...upper, ...lower].join("L")}Z`;
      upper = [];
      lower = [];
    };
    values.forEach((value, row) => {
      if (!isFinite(value) || !isFinite(sigma[row])) return end();
      const x = this.x(this.time[row]).toFixed(1);
      const clip = (y) => Math.min(Math.max(y, this.top), this.bottom).toFixed(1);
      upper.push(`${x} ${clip(this.y(value + sigma[row]))}`);
      lower.unshift(`${x} ${clip(this.y(value - sigma[row]))}`);
    });
    end();
    return text;
  }

  show(row) {
    const x = this.x(this.time[row]);
    this.cursor.setAttribute("x1", x);
    this.cursor.setAttribute("x2", x);
    this.value.replaceChildren(...this.lines.flatMap(({ name, color, values, sigma }) => {
      const part = document.createElement("span");
      const words = (value) => (this.digits === undefined || !isFinite(value) ? short(value) : value.toFixed(this.digits).replace("-", "−"));
      const about = sigma && isFinite(sigma[row]) ? ` ± ${words(sigma[row])}` : "";
      part.textContent = `${name ? name + " " : ""}${words(values[row])}${about}${this.unit}`;
      part.style.color = color;
      return ["  ", part];
    }));
  }
}
