"use strict";
// Fills the page from the data, and shows the same frame in all its parts.

(function () {
  const data = JSON.parse(document.getElementById("data").textContent);
  const get = (id) => document.getElementById(id);
  const count = data.frames.length;
  const lost = data.status.map((status) => data.withoutPose.includes(status));
  const lostCount = lost.filter(Boolean).length;
  const silhouetteError = data.silhouetteError && unpack(data.silhouetteError);
  const sigma = data.sigma && unpack(data.sigma), expected = data.expected && unpack(data.expected);
  const objective = unpack(data.objective);
  const C = data.cameras.length, J = data.joints.length;
  const segments = data.colors.segments;
  const root = document.documentElement.style;
  root.setProperty("--left-deep", segments.upper_arm_l);
  root.setProperty("--left-pale", segments.forearm_l);
  root.setProperty("--right-deep", segments.upper_arm_r);
  root.setProperty("--right-pale", segments.forearm_r);

  const make = (name, text = "", className = "") => {
    const made = document.createElement(name);
    made.textContent = text;
    if (className) made.className = className;
    return made;
  };
  const quantile = (values, share) => {
    const sorted = Array.from(values).filter((value) => isFinite(value)).sort((a, b) => a - b);
    return sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))] : NaN;
  };
  const column = (values, width, k) => Array.from({ length: values.length / width }, (_, row) => values[row * width + k]);
  const rows = (values, width) => Array.from(values).filter((_, k) => !lost[Math.floor(k / width)]);
  const good = (values) => values.filter((_, row) => !lost[row]);
  const joint = (name) => name.replace(/^(.*)_([lr])$/, (_, part, side) => `${side === "l" ? "left" : "right"} ${part}`).replace("_", " ");

  // --- header
  get("title").textContent = data.capture;
  const when = data.created.slice(0, 16).replace("T", " ");
  get("subtitle").textContent = `${data.file} · ${count} frames at ${short(data.fps)} Hz · method ${data.method} · ${data.software}${when ? ` · ${when} UTC` : ""}`;
  const addFigure = (name, value, unit = "", bad = false) => {
    const box = make("div", "", bad ? "bad" : "");
    const number = make("dd", value);
    if (unit) number.append(" ", make("small", unit));
    box.append(make("dt", name), number);
    get("figures").append(box);
  };
  const suspect = data.statusWords.indexOf("suspect");
  const suspectCount = data.status.filter((status) => status === suspect).length;
  if (lostCount + suspectCount > 0.2 * count) get("title").textContent += `: ${lostCount + suspectCount} of ${count} frames are lost or suspect`;
  addFigure("lost frames", String(lostCount), `of ${count}`, lostCount > 0);
  if (suspectCount) addFigure("suspect frames", String(suspectCount), `of ${count}`, true);
  const meanError = silhouetteError && Array.from({ length: count }, (_, row) => {
    const known = Array.from(silhouetteError.subarray(row * C, row * C + C)).filter(isFinite);
    return known.length ? known.reduce((a, b) => a + b) / known.length : NaN;
  });
  if (meanError) addFigure("E_S, median frame", short(100 * quantile(good(meanError), 0.5)), "%");
  if (expected) addFigure("expected error of a joint, median", short(100 * quantile(rows(expected, J), 0.5)), "cm");
  const total = data.timing.find(({ stage }) => stage === "total");
  if (total) addFigure("time per frame, mean", short(total.ms), "ms");

  // --- current frame
  const viewer = new Viewer(get("view"), data);
  const charts = [];
  let row = -1, playing = false, clock = 0, startedAt = 0, startedTime = 0;
  const bars = (holder, title, names, unit) => {
    const box = make("div", "", "bars");
    box.append(make("b", title));
    const made = names.map((name) => {
      const fill = make("i"), track = make("span", "", "track"), number = make("span", "", "number");
      track.append(fill);
      box.append(make("span", name), track, number);
      return (value, most, color) => {
        fill.style.width = `${isFinite(value) ? Math.min(100, 100 * value / most) : 0}%`;
        if (color) fill.style.background = color;
        number.textContent = isFinite(value) ? `${listed(value)} ${unit}` : "–";
      };
    });
    get(holder).append(box);
    return made;
  };
  const errorBars = silhouetteError ? bars("now-cameras", "E_S of each camera", data.cameras, "%") : [];
  const sigmaBars = sigma ? bars("now-joints", "σ of each joint", data.joints.map(joint), "mm") : [];
  if (!silhouetteError && !sigma) get("now-joints").append(make("p", "This result has neither E_S nor σ.", "muted"));
  const mostError = silhouetteError ? Math.max(quantile(silhouetteError, 0.99) * 100, 1) : 1;

  function show(wanted) {
    const next = Math.min(Math.max(wanted, 0), count - 1);
    if (next === row) return;
    row = next;
    viewer.show(row);
    get("scrubber").value = row;
    get("scrubber").setAttribute("aria-valuetext", `frame ${data.frames[row]}, ${data.statusWords[data.status[row]]}`);
    get("clock").textContent = `frame ${data.frames[row]} · ${data.time[row].toFixed(2)} s`;
    get("status").textContent = data.statusWords[data.status[row]];
    get("status").dataset.status = data.status[row];
    get("badge").hidden = !lost[row];
    document.querySelector(".stage").classList.toggle("lost", lost[row]);
    errorBars.forEach((set, k) => set(100 * silhouetteError[row * C + k], mostError));
    sigmaBars.forEach((set, k) => {
      const value = sigma[row * J + k];
      set(1000 * value, 1000 * data.colors.sigmaMost, isFinite(value) ? sigmaColor(data.colors, value) : "");
    });
    for (const chart of charts) chart.show(row);
    drawStrip();
  }

  // --- time
  const speed = () => Number(get("speed").value);
  function play(on) {
    playing = on;
    if (on && row === count - 1) show(0);
    startedAt = performance.now();
    startedTime = data.time[row];
    get("play").textContent = on ? "❚❚" : "▶";
    get("play").setAttribute("aria-label", on ? "Stop" : "Play");
    cancelAnimationFrame(clock);
    if (on) clock = requestAnimationFrame(tick);
  }
  function tick(now) {
    const time = startedTime + Math.max(now - startedAt, 0) / 1000 * speed();
    let next = row;
    while (next + 1 < count && data.time[next + 1] <= time) next++;
    show(next);
    if (row === count - 1) play(false);
    else if (playing) clock = requestAnimationFrame(tick);
  }
  const seek = (wanted) => { play(false); show(wanted); };
  get("scrubber").max = count - 1;
  get("scrubber").addEventListener("input", (event) => seek(Number(event.target.value)));
  get("play").addEventListener("click", () => play(!playing));
  get("speed").addEventListener("change", () => play(playing));
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.target.matches("select, summary")) return;
    const step = event.shiftKey ? 10 : 1;
    const jumps = { ArrowLeft: row - step, ArrowRight: row + step, Home: 0, End: count - 1 };
    if (event.key === " " && !event.target.matches("input[type=checkbox], #shots button")) play(!playing);
    else if (event.key in jumps) seek(jumps[event.key]);
    else return;
    event.preventDefault();
  });
  // the button would react to the space bar a second time when the key is released
  document.addEventListener("keyup", (event) => {
    if (event.key === " " && event.target === get("play")) event.preventDefault();
  });
  for (const [id, part] of [["show-body", "body"], ["show-bones", "bones"], ["show-cameras", "cameras"]]) {
    get(id).addEventListener("change", (event) => { viewer.shown[part] = event.target.checked; viewer.draw(); });
  }
  if (!viewer.solids.length) get("show-body").parentElement.remove();
  if (!viewer.cameras.length) get("show-cameras").parentElement.remove();

  function drawStrip() {
    const strip = get("strip"), width = strip.width = strip.clientWidth, pen = strip.getContext("2d");
    const style = getComputedStyle(document.documentElement);
    const colors = ["--ok", "--initialised", "--recovered", "--lost", "--suspect", "--wire"].map((name) => style.getPropertyValue(name).trim());
    // lost frames last and at least a pixel wide: one in ten thousand must stay visible
    for (const wanted of [false, true]) {
      data.status.forEach((status, k) => {
        if (lost[k] !== wanted) return;
        pen.fillStyle = colors[status];
        pen.fillRect(Math.floor(k / count * width), 0, Math.max(Math.ceil(width / count), 1), 8);
      });
    }
  }
  new ResizeObserver(drawStrip).observe(get("strip"));

  // --- curves
  const common = { time: data.time, lost, seek };
  const wide = innerWidth > 560 ? 1240 : 400; // of charts over the whole page, so that their text has the same size as elsewhere
  const hues = Array.from({ length: 9 }, (_, k) => `var(--hue-${k})`);
  if (meanError) {
    get("quality-text").textContent = "E_S is the share of wrong pixels: body outside the mask, or mask outside the body. Lower is better. Red: lost frames. Click a curve to go to a frame.";
    charts.push(new Chart(get("quality-charts"), {
      ...common, title: "E_S of each camera", unit: " %", width: wide, height: 190, zero: true, digits: 1,
      lines: data.cameras.map((name, k) => ({ name, color: hues[k % hues.length], values: column(silhouetteError, C, k).map((v) => 100 * v) })),
    }));
  } else {
    get("quality-text").textContent = "This result has no E_S. Red: lost frames. Click a curve to go to a frame.";
  }
  const kind = data.objectiveKind ? ` (${data.objectiveKind})` : "";
  charts.push(new Chart(get("quality-charts"), {
    ...common, title: `Objective${kind}`, unit: "", width: wide, height: 110, zero: true,
    lines: [{ name: "", color: "var(--accent)", values: Array.from(objective) }],
  }));
  const tints = { left: "var(--left)", right: "var(--right)", middle: "var(--middle)" };
  if (data.angles.length) {
    const banded = data.angles.some(({ lines }) => lines.some((line) => line.sigma));
    get("angles-text").textContent = "Degrees. Left warm, right cool. Point at a title to read its convention (ISB where it defines one). "
      + (banded ? "Bands: ± one σ, computed from independent positions of the three joints; other angles have no σ." : "No σ is available.");
    for (const panel of data.angles) {
      charts.push(new Chart(get("angle-charts"), {
        ...common, title: panel.title, unit: "°", hint: panel.convention, wraps: true, least: 20, digits: 1,
        lines: panel.lines.map((line) => ({
          name: line.side === "middle" ? "" : line.side, color: tints[line.side],
          values: Array.from(unpack(line.values)), sigma: line.sigma && Array.from(unpack(line.sigma)),
        })),
      }));
    }
  } else {
    get("angles-text").textContent = "This result has no joint angles.";
  }

  // --- pictures
  get("pictures-text").textContent = data.pictures.length
    ? "The tracked body over the images: left limbs warm, right limbs cool. Dots are joints, from pale yellow (small σ) to dark violet (σ of 5 cm or more). Click an image to go to its frame."
    : "No images: the report was made without the capture. tk report RESULT.h5 CAPTURE adds them.";
  for (const picture of data.pictures) {
    const figure = make("figure"), caption = make("figcaption"), button = make("button"), image = make("img");
    const at = `frame ${data.frames[picture.row]}, ${data.time[picture.row].toFixed(2)} s`;
    caption.append(make("b", at), ` · ${picture.why}`);
    image.alt = `Overlay of ${at}, all cameras`;
    image.src = `data:image/jpeg;base64,${picture.jpeg}`;
    button.type = "button";
    button.setAttribute("aria-label", `Go to ${at}`);
    button.append(image);
    button.addEventListener("click", () => { seek(picture.row); scrollTo({ top: 0, behavior: "smooth" }); });
    figure.append(caption, button);
    get("shots").append(figure);
  }

  // --- tables
  const line = (cells, kind = "td") => {
    const made = make("tr");
    cells.forEach((cell, k) => {
      const box = make(kind, typeof cell === "string" ? cell : "", k && typeof cell === "string" ? "number" : "");
      if (typeof cell !== "string") box.append(cell);
      made.append(box);
    });
    return made;
  };
  if (sigma) {
    get("sigma-text").textContent = "One standard deviation of a joint position along one axis, mm; frames that are not lost. "
      + "Expected error: distance to the true position, median, mm; it adds the constant offset that a joint of this kind had on rendered recordings.";
    get("sigma-table").append(line(["joint", "median", "90 %", "largest", "expected error"], "th"));
    data.joints.forEach((name, k) => {
      const values = good(column(sigma, J, k));
      get("sigma-table").append(line([
        joint(name), ...[0.5, 0.9, 1].map((share) => listed(1000 * quantile(values, share))),
        listed(1000 * quantile(good(column(expected, J, k)), 0.5)),
      ]));
    });
  } else {
    get("sigma-text").textContent = "This result has no σ.";
  }
  if (data.truth) {
    get("truth").hidden = false;
    charts.push(new Chart(get("truth-charts"), {
      ...common, title: "Mean error of the joints", unit: " cm", width: wide, height: 110, zero: true, digits: 1,
      lines: [{ name: "", color: "var(--accent)", values: Array.from(unpack(data.truth.frames)) }],
    }));
    get("truth-table").append(line(["joint", "mean", "without offset"], "th"));
    for (const [name, ...errors] of data.truth.rows) {
      get("truth-table").append(line([joint(name), ...errors.map((error) => error === null ? "–" : error.toFixed(2))]));
    }
  }
  get("times-text").textContent = "Mean, ms. Decoding and segmentation run in a separate process and are not part of the total.";
  get("times-table").append(line(["stage", "", "ms"], "th"));
  const longest = Math.max(...data.timing.map(({ ms }) => ms), 1e-9);
  for (const { stage, ms } of data.timing) {
    const track = make("div", "", "track"), fill = make("i");
    fill.style.width = `${100 * ms / longest}%`;
    track.append(fill);
    get("times-table").append(line([stage.replace("_", " "), track, listed(ms)]));
  }

  // --- notes and settings
  for (const note of data.notes.length ? data.notes : ["None."]) get("notes").append(make("li", note));
  get("settings").textContent = data.settings;
  get("foot").textContent = `Made by ${data.software} from ${data.file}; seed ${data.seed}. The page needs no network.`;

  show(0);
  window.report = { show, play, get row() { return row; }, get playing() { return playing; }, count };
})();
