// Frame by frame, 3 of 3: the panel of the shown frame, and what hands can do.
const over = (signal, i) => signal.threshold !== null && value(run.signals.indexOf(signal), i) > signal.threshold;
const unit = (signal) => (signal.unit === "1" ? "" : ` ${signal.unit}`);
const told = (signal) => `${signal.about}${unit(signal) && ` [${signal.unit}]`}`;
const level = (signal) => (signal.threshold === null ? "—" : number(signal.threshold));
const bar = (excess, widest) => {
  const made = document.createElement("td"), rod = document.createElement("span");
  const text = document.createElement("span");
  text.textContent = `${excess >= 0 ? "+" : "−"}${number(Math.abs(excess), 3)}`;
  rod.className = excess >= 0 ? "rod out" : "rod in";
  rod.style.width = `${Math.round((44 * Math.abs(excess)) / widest)}px`;
  made.append(text, rod);
  made.className = "odds";
  return made;
};
const fillTerms = (i) => {
  const { columns, mean, scale: size, weight } = run.model;
  const excess = columns.map((c, j) => ((value(c, i) - mean[j]) / size[j]) * weight[j]);
  const widest = Math.max(1, ...excess.map(Math.abs));
  const order = columns.map((_, j) => j).sort((a, b) => excess[b] - excess[a]);
  fill("route-terms", order.map((j) => {
    const signal = run.signals[columns[j]];
    return [
      cell(signal.name, told(signal), "text"),
      cell(number(value(columns[j], i)) + unit(signal)), bar(excess[j], widest),
    ];
  }));
  // What the verdict reads stands among its terms.
  fill("route-signals", run.signals.flatMap((signal, j) => signal.feature ? [] : [[
    cell(signal.name, told(signal), "text"), cell(number(value(j, i)) + unit(signal)),
    cell(level(signal)), cell(over(signal, i) ? "▲" : "", "above its own threshold", "text"),
  ]]));
};
const fillCandidates = (i) => {
  const lines = [];
  let count = 0;
  for (let rank = 0; rank < k; rank++) {
    const row = rows[i * k + rank];
    if (!row) continue;
    count += 1;
    if (lines.length === 5) continue;
    const off = Math.hypot(map[2 * row - 2] - truth[2 * i], map[2 * row - 1] - truth[2 * i + 1]);
    lines.push([cell(String(rank + 1)), cell(String(row - 1)),
      cell(similarity(i, rank).toFixed(3)), cell(metres(off))]);
  }
  fill("route-candidates", lines);
  const of = k < run.candidates.of ? ` (the best ${k} of ${run.candidates.of} are on this page)` : "";
  at("route-count").textContent = `${count} candidates${of}; the five most similar:`;
};
let later;
const show = (wanted, { quiet = false } = {}) => {
  const i = (frame = Math.max(0, Math.min(n - 1, wanted)));
  const name = i * run.every, verdict = VERDICT[run.verdict[i]];
  const kind = run.kinds[Number(run.kind[i])], p = value(doubt, i);
  at("route").dataset.frame = name;
  at("route-scrub").value = i;
  at("route-scrub").setAttribute("aria-valuetext", `frame ${name}: ${verdict}`);
  at("route-frame").value = name;
  at("route-badge").textContent = verdict;
  at("route-badge").className = `badge ${kind.name}`;
  at("route-outcome").textContent = `Frame ${name}: ${kind.label}`;
  at("route-reason").textContent = run.reasons[run.reason[i]];
  at("route-truth").textContent =
    `${LABEL[run.label[i]]}, ${metres(nearest[i])} to the nearest map pose`;
  const x = pose[2 * i] + run.origin[0], y = pose[2 * i + 1] + run.origin[1];
  at("route-pose").textContent = known(pose, i)
    ? `x = ${x.toFixed(1)} m, y = ${y.toFixed(1)} m; ${metres(error[i])} from the truth` : "none";
  at("route-split").textContent =
    `${SPLIT[run.split[i]]}; status ${run.statuses[Number(run.status[i])]}`;
  const threshold = run.model.threshold;
  at("route-p").textContent = Number.isNaN(p) ? "—"
    : `${number(p)}${threshold === null ? "" : `, threshold ${number(threshold)}`}`;
  at("route-meter").style.width = `${Number.isNaN(p) ? 0 : 100 * p}%`;
  at("route-tick").style.left = `${100 * (threshold ?? 0)}%`;
  at("route-cursor").setAttribute("d", `M${i + 0.5} 0V70`);
  fillTerms(i);
  fillCandidates(i);
  drawMoving(i);
  aim();
  if (quiet) return;
  // Late, because browsers refuse addresses that change with every repeat of a held key.
  clearTimeout(later);
  later = setTimeout(() => {
    try { history.replaceState(null, "", `#frame=${name}`); } catch { /* a viewer without history */ }
  }, 250);
};

// ---- hands ----
const resize = (step) => {
  zoom = Math.max(0, Math.min(ZOOMS.length - 1, zoom + step));
  at("route-out").disabled = zoom === 0;
  at("route-in").disabled = zoom === ZOOMS.length - 1;
  drawStill();
  drawMoving(frame);
  aim();
};
const nextOf = (number) => {
  // Test frames first: they are the ones that were counted.
  for (const split of ["t", "cg"]) {
    for (let step = 1; step <= n; step++) {
      const i = (frame + step) % n;
      if (Number(run.kind[i]) === number && split.includes(run.split[i])) return show(i);
    }
  }
};
const drawKey = () => {
  run.kinds.forEach((kind, number) => {
    let tests = 0, others = 0;
    for (let i = 0; i < n; i++) {
      if (Number(run.kind[i]) !== number) continue;
      if (run.split[i] === "t") tests += 1; else others += 1;
    }
    if (!tests && !others) return;
    const button = document.createElement("button");
    button.type = "button";
    button.title = "Go to the next such frame";
    const sign = draw(button, "svg", { viewBox: "-7 -7 14 14", width: 14, height: 14, "aria-hidden": "true" });
    draw(sign, "path", { class: `mark ${kind.name}`, d: spot(kind.marker, [0, 0]) });
    button.append(` ${kind.label} (${tests})`);
    button.addEventListener("click", () => nextOf(number));
    at("route-key").append(button);
  });
};
const fromHash = () => {
  const match = /^#frame=(\d+)$/.exec(location.hash);
  return match ? Math.round(Number(match[1]) / run.every) : null;
};
const first = () => {
  const names = run.kinds.map((kind) => kind.name);
  for (const name of ["accepted_wrong", "rejected_out", "accepted_in"]) {
    for (let i = Math.max(0, run.split.indexOf("t")); i < n; i++) {
      if (Number(run.kind[i]) === names.indexOf(name)) return i;
    }
  }
  return 0;
};
view.addEventListener("click", (event) => {
  const box = view.getBoundingClientRect(), [dx, dy] = aim();
  const x = ((event.clientX - box.left) * WIDE) / box.width - dx;
  const y = ((event.clientY - box.top) * HIGH) / box.height - dy;
  let best = 0, least = Infinity;
  for (let i = 0; i < n; i++) {
    const [a, b] = place(truth, i), off = Math.hypot(a - x, b - y);
    if (off < least) [best, least] = [i, off];
  }
  show(best);
});
strip.addEventListener("click", (event) => {
  const box = strip.getBoundingClientRect();
  show(Math.floor(((event.clientX - box.left) * n) / box.width));
});
at("route-scrub").addEventListener("input", (event) => show(Number(event.target.value)));
at("route-frame").addEventListener("change", (event) => {
  show(Math.round(Number(event.target.value) / run.every));
});
at("route-back").addEventListener("click", () => show(frame - 1));
at("route-on").addEventListener("click", () => show(frame + 1));
at("route-in").addEventListener("click", () => resize(1));
at("route-out").addEventListener("click", () => resize(-1));
document.addEventListener("keydown", (event) => {
  const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
  if (!step || event.altKey || event.ctrlKey || event.metaKey) return;
  if (event.target.closest && event.target.closest("input, .scroll")) return;
  event.preventDefault();
  show(frame + step * (event.shiftKey ? 10 : 1));
});
window.addEventListener("hashchange", () => { if (fromHash() !== null) show(fromHash(), { quiet: true }); });

at("route-scrub").max = n - 1;
at("route-frame").max = (n - 1) * run.every;
at("route-frame").step = run.every;
at("route").hidden = false;
drawKey();
drawStrip();
frame = fromHash() ?? first();
resize(0);
show(frame, { quiet: true });
