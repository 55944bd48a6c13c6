"use strict";
// Fills the page from the data, and shows the same frame in all its parts. Each person has a block; all have the same
// frames. The block of person n > 0 is a copy whose ids end in -n.

(function () {
  const data = JSON.parse(document.getElementById("data").textContent);
  const get = (id, n = 0) => document.getElementById(n ? `${id}-${n}` : id);
  const count = data.frames.length, several = data.people.length > 1;
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
  const joint = (name) => name.replace(/^(.*)_([lr])$/, (_, part, side) => `${side === "l" ? "left" : "right"} ${part}`).replace("_", " ");

  // --- header
  get("title").textContent = data.capture;
  const others = data.people.slice(1).map((person, k) => [`Person ${person.number}`, [data.colors.people[k + 1]]]);
  for (const [name, colors] of [...Object.entries(data.colors.sides), ...others]) {
    const entry = document.createElement("span");
    for (const color of colors) entry.append(document.createElement("i"));
    entry.querySelectorAll("i").forEach((square, k) => { square.style.background = colors[k]; });
    entry.append(` ${name}`);
    get("key").append(entry);
  }
  const when = data.created.slice(0, 16).replace("T", " ");
  get("subtitle").textContent = `${data.file} · ${data.frameCount} frames at ${short(data.fps)} Hz${data.step > 1 ? `, one of ${data.step} is shown` : ""} · method ${data.method} · ${data.software}${when ? ` · ${when} UTC` : ""}`;
  const line = (cells, kind = "td") => {
    const made = make("tr");
    cells.forEach((cell, k) => {
      const box = make(kind, typeof cell === "string" ? cell : "", k && typeof cell === "string" ? "number" : "");
      if (typeof cell !== "string") box.append(cell);
      made.append(box);
    });
    return made;
  };
  for (const id of ["now-person", "person"]) {
    const original = get(id), copies = data.people.slice(1).map((_, k) => {
      const copy = original.cloneNode(true);
      for (const part of [copy, ...copy.querySelectorAll("[id]")]) part.id += `-${k + 1}`;
      return copy;
    });
    original.after(...copies);
  }
  const mean = (values) => (values.length ? values.reduce((a, b) => a + b) / values.length : NaN);
  const people = data.people.map((person, n) => {
    const positions = unpack(person.positions);
    const there = Array.from({ length: count }, (_, row) => positions.subarray(3 * J * row, 3 * J * (row + 1)).some(isFinite));
    const lost = person.status.map((status, row) => there[row] && data.withoutPose.includes(status));
    const silhouetteError = person.silhouetteError && unpack(person.silhouetteError);
    const good = (values) => values.filter((_, row) => there[row] && !lost[row]);
    return {
      ...person, n, name: `Person ${person.number}`, color: data.colors.people[n], there, lost, good,
      silhouetteError, sigma: person.sigma && unpack(person.sigma),
      meanError: silhouetteError && Array.from({ length: count }, (_, row) => mean(Array.from(silhouetteError.subarray(row * C, row * C + C)).filter(isFinite))),
    };
  });
  const sum = (values) => values.reduce((a, b) => a + b, 0);
  const bad = sum(people.map((person) => person.lostCount + person.suspectCount)), all = sum(people.map((person) => person.present));
  // a camera counts as used if it was left out of less than half of the frames with a pose
  const posed = Math.max(...people.map((person) => person.present - person.lostCount));
  const leftOut = data.leftOut.map((frames, k) => ({ name: data.cameras[k], frames })).filter(({ frames }) => frames > 0);
  const used = C - leftOut.filter(({ frames }) => 2 * frames > posed).length;
  const headlines = [];
  if (used < C) headlines.push(`${used} of ${C} cameras used`);
  if (bad > 0.2 * all) headlines.push(`${bad} of ${all} frames are lost or suspect`);
  if (headlines.length) get("title").textContent += `: ${headlines.join(", ")}`;
  get("left-out").hidden = !leftOut.length;
  get("left-out").textContent = `Left out: ${leftOut.map(({ name, frames }) => `${name} (${frames >= posed ? "all" : `${frames} of ${posed}`} frames)`).join(", ")}. The notes at the end of the page give the reasons.`;
  const EXPECTED = "Distance of the raw joint positions from the anatomical joints, mean over joints and frames. It contains the constant offset of each joint in the body, "
    + "which σ does not contain. The offset depends on the person: the range holds for 90 % of the people in recordings with known joints.";
  const figuresOf = (person) => [
    ["lost frames", String(person.lostCount), `of ${person.present}`, person.lostCount > 0],
    ["suspect frames", String(person.suspectCount), `of ${person.present}`, person.suspectCount > 0],
    ["E_S, median frame", person.meanError ? short(100 * quantile(person.good(person.meanError), 0.5)) : "", "%"],
    ["expected mean error of the joints", person.expectedMean.replace(" cm", ""), "cm", false, EXPECTED],
  ];
  if (several) {
    get("figures").remove();
    get("people").hidden = false;
    get("people").append(line(["", ...figuresOf(people[0]).map(([name]) => name)], "th"));
    for (const person of people) {
      const link = make("a", person.name);
      link.href = `#person${person.n ? `-${person.n}` : ""}`;
      link.style.setProperty("--color", person.color);
      get("people").append(line([link, ...figuresOf(person).map(([, value, unit]) => (value ? `${value} ${unit}` : ""))]));
    }
  } else {
    const [person] = people, total = person.timing.find(({ stage }) => stage === "total");
    const figures = [["cameras used", String(used), `of ${C}`, used < C], ...figuresOf(person)].filter(([name, value]) => value && (value !== "0" || name !== "suspect frames") && (C || name !== "cameras used"));
    if (total) figures.push(["time per frame, mean", short(total.ms), "ms"]);
    for (const [name, value, unit, isBad, hint] of figures) {
      const box = make("div", "", isBad ? "bad" : ""), number = make("dd", value);
      if (hint) box.title = hint;
      number.append(" ", make("small", unit));
      box.append(make("dt", name), number);
      get("figures").append(box);
    }
  }

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
      return (value, most, color, missing = "–") => {
        fill.style.width = `${isFinite(value) ? Math.min(100, 100 * value / most) : 0}%`;
        if (color) fill.style.background = color;
        number.textContent = isFinite(value) ? `${listed(value)} ${unit}` : missing;
      };
    });
    holder.append(box);
    return made;
  };
  for (const person of people) {
    const { n, silhouetteError, sigma } = person;
    person.errorBars = silhouetteError ? bars(get("now-cameras", n), "E_S of each camera", data.cameras, "%") : [];
    person.sigmaBars = sigma ? bars(get("now-joints", n), "σ of each joint", data.joints.map(joint), "mm") : [];
    person.mostError = silhouetteError ? Math.max(quantile(silhouetteError, 0.99) * 100, 1) : 1;
    if (!silhouetteError && !sigma) get("now-joints", n).append(make("p", "This result has neither E_S nor σ.", "muted"));
    get("now-person", n).open = !n;
    for (const id of several ? ["now-who", "who"] : []) {
      get(id, n).textContent = person.name;
      get(id, n).style.setProperty("--color", person.color);
      get(id, n).hidden = false;
    }
  }

  const silhouetteErrors = ({ silhouetteError }, row) => (silhouetteError ? Array.from(silhouetteError.subarray(row * C, row * C + C)) : []);

  function show(wanted) {
    const next = Math.min(Math.max(wanted, 0), count - 1);
    if (next === row) return;
    row = next;
    viewer.show(row);
    get("scrubber").value = row;
    const words = people.map(({ status }) => data.statusWords[status[row]]);
    get("scrubber").setAttribute("aria-valuetext", `frame ${data.frames[row]}, ${words.join(", ")}`);
    get("clock").textContent = `frame ${data.frames[row]} · ${data.time[row].toFixed(2)} s`;
    for (const person of people) {
      get("status", person.n).textContent = words[person.n];
      if (several) get("now-who", person.n).textContent = `${person.name}: ${words[person.n]}`;
      get("status", person.n).dataset.status = person.status[row];
      const errors = silhouetteErrors(person, row), missing = errors.some(isFinite) ? "left out" : "–";
      person.errorBars.forEach((set, k) => set(100 * errors[k], person.mostError, "", missing));
      person.sigmaBars.forEach((set, k) => {
        const value = person.sigma[row * J + k];
        set(1000 * value, 1000 * data.colors.sigmaMost, isFinite(value) ? sigmaColor(data.colors, value) : "");
      });
    }
    const missing = people.filter(({ lost }) => lost[row]);
    get("badge").hidden = !missing.length;
    get("badge").textContent = several ? `lost: ${missing.map(({ name }) => name.toLowerCase()).join(", ")}` : "lost: do not use this pose";
    document.querySelector(".stage").classList.toggle("lost", missing.length > 0);
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
  if (!viewer.people.some(({ solids }) => solids.length)) get("show-body").parentElement.remove();
  if (!viewer.cameras.length) get("show-cameras").parentElement.remove();

  function drawStrip() {
    const strip = get("strip"), width = strip.width = strip.clientWidth, pen = strip.getContext("2d");
    const style = getComputedStyle(document.documentElement);
    const colors = ["--ok", "--initialised", "--recovered", "--lost", "--suspect", "--wire"].map((name) => style.getPropertyValue(name).trim());
    // lost frames last and at least a pixel wide: one in ten thousand must stay visible
    const high = strip.height / people.length;
    for (const wanted of [false, true]) {
      for (const { status, lost, n } of people) {
        status.forEach((value, k) => {
          if (lost[k] !== wanted) return;
          pen.fillStyle = colors[value];
          pen.fillRect(Math.floor(k / count * width), n * high, Math.max(Math.ceil(width / count), 1), high);
        });
      }
    }
  }
  new ResizeObserver(drawStrip).observe(get("strip"));

  // --- pictures
  get("pictures-text").textContent = data.pictures.length
    ? "The tracked body over the images: left limbs warm, right limbs cool, trunk and head green. The image of a camera that was left out is dark. Dots are joints, from pale yellow (small σ) to dark violet (σ of 5 cm or more). Click an image to go to its frame."
    : "No images: the report was made without the capture. tk report RESULT.h5 CAPTURE adds them.";
  for (const picture of data.pictures) {
    const figure = make("figure"), caption = make("figcaption"), button = make("button"), image = make("img");
    const at = `frame ${picture.frame}, ${picture.time.toFixed(2)} s`;
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

  // --- a block for each person
  const wide = innerWidth > 560 ? 1240 : 400; // of charts over the whole page, so that their text has the same size as elsewhere
  const hues = Array.from({ length: 9 }, (_, k) => `var(--hue-${k})`);
  const tints = { left: "var(--left)", right: "var(--right)", middle: "var(--middle)" };
  for (const person of people) {
    const { n, lost, good, silhouetteError, meanError, sigma, expected } = person;
    const objective = unpack(person.objective), common = { time: data.time, lost, seek };
    if (meanError) {
      get("quality-text", n).textContent = "E_S is the share of wrong pixels: body outside the mask, or mask outside the body. Lower is better. Red: lost frames. Click a curve to go to a frame.";
      charts.push(new Chart(get("quality-charts", n), {
        ...common, title: "E_S of each camera", unit: " %", width: wide, height: 190, zero: true, digits: 1,
        lines: data.cameras.map((name, k) => ({ name, color: hues[k % hues.length], values: column(silhouetteError, C, k).map((v) => 100 * v) })),
      }));
    } else {
      get("quality-text", n).textContent = "This result has no E_S. Red: lost frames. Click a curve to go to a frame.";
    }
    const kind = data.objectiveKind ? ` (${data.objectiveKind})` : "";
    charts.push(new Chart(get("quality-charts", n), {
      ...common, title: `Objective${kind}`, unit: "", width: wide, height: 110, zero: true,
      lines: [{ name: "", color: "var(--accent)", values: Array.from(objective) }],
    }));
    if (person.angles.length) {
      const banded = person.angles.some(({ lines }) => lines.some((line) => line.sigma));
      get("angles-text", n).textContent = "Degrees. Left warm, right cool. Point at a title to read its convention (ISB where it defines one). "
        + (banded ? "Bands: ± one σ, computed from independent positions of the three joints; other angles have no σ." : "No σ is available.")
        + person.unmeasured.map((text) => ` Not measured: ${text.replaceAll("_", " ")}.`).join("");
      for (const panel of person.angles) {
        charts.push(new Chart(get("angle-charts", n), {
          ...common, title: panel.title, unit: "°", hint: panel.convention, wraps: true, least: 20, digits: 1,
          lines: panel.lines.map((line) => ({
            name: line.side === "middle" ? "" : line.side, color: tints[line.side],
            values: Array.from(unpack(line.values)), sigma: line.sigma && Array.from(unpack(line.sigma)),
          })),
        }));
      }
    } else {
      get("angles-text", n).textContent = "This result has no joint angles.";
    }

    if (sigma) {
      get("sigma-text", n).textContent = "One standard deviation of a joint position along one axis, mm; frames that are not lost. "
        + "Expected error: distance of the raw position from the true one, mean over the frames; a range, because the constant offset of the joint, which σ does not contain, depends on the person.";
      get("sigma-table", n).append(line(["joint", "median", "90 %", "largest", "expected error"], "th"));
      data.joints.forEach((name, k) => {
        const values = good(column(sigma, J, k));
        get("sigma-table", n).append(line([
          joint(name), ...[0.5, 0.9, 1].map((share) => listed(1000 * quantile(values, share))),
          expected[k],
        ]));
      });
    } else {
      get("sigma-text", n).textContent = "This result has no σ.";
    }
    if (person.truth) {
      get("truth", n).hidden = false;
      charts.push(new Chart(get("truth-charts", n), {
        ...common, title: "Mean error of the joints", unit: " cm", width: wide, height: 110, zero: true, digits: 1,
        lines: [{ name: "", color: "var(--accent)", values: Array.from(unpack(person.truth.frames)) }],
      }));
      get("truth-table", n).append(line(["joint", "mean", "without offset"], "th"));
      for (const [name, ...errors] of person.truth.rows) {
        get("truth-table", n).append(line([joint(name), ...errors.map((error) => error === null ? "–" : error.toFixed(2))]));
      }
    }
    get("times-text", n).textContent = "Mean, ms. Decoding and segmentation run in a separate process and are not part of the total.";
    get("times-table", n).append(line(["stage", "", "ms"], "th"));
    const longest = Math.max(...person.timing.map(({ ms }) => ms), 1e-9);
    for (const { stage, ms } of person.timing) {
      const track = make("div", "", "track"), fill = make("i");
      fill.style.width = `${100 * ms / longest}%`;
      track.append(fill);
      get("times-table", n).append(line([stage.replace("_", " "), track, listed(ms)]));
    }
  }

  // --- notes and settings
  for (const note of data.notes.length ? data.notes : ["None."]) get("notes").append(make("li", note));
  get("settings").textContent = data.settings;
  get("foot").textContent = `Made by ${data.software} from ${data.file}; seed ${data.seed}. The page needs no network.`;

  show(0);
  window.report = { show, play, get row() { return row; }, get playing() { return playing; }, count };
})();
