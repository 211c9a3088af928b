// Frame by frame, 1 of 3: the frames as arrays, and small builders. The page joins the parts.
const at = (id) => document.getElementById(id);
const run = JSON.parse(at("route-data").textContent);
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
const floats = (text) => new Float32Array(bytes(text));
const map = floats(run.map), truth = floats(run.truth), pose = floats(run.pose);
const nearest = floats(run.nearest), error = floats(run.error), values = floats(run.values);
const rows = run.candidates.wide
  ? new Uint32Array(bytes(run.candidates.row)) : new Uint16Array(bytes(run.candidates.row));
const alike = new Uint16Array(bytes(run.candidates.alike));
const n = run.verdict.length, k = run.candidates.k;
const doubt = run.signals.findIndex((signal) => signal.name === "probability_wrong");
const value = (signal, i) => values[signal * n + i];
const share = (i, rank) => alike[i * k + rank] / 65535;
const similarity = (i, rank) =>
  run.candidates.low + share(i, rank) * (run.candidates.high - run.candidates.low);
const VERDICT = { a: "accept", r: "reject", "-": "abstain" };
const LABEL = { i: "in-map", o: "map-out", g: "grey zone" };
const SPLIT = { c: "calibration split", g: "gap, in neither split", t: "test split" };
const number = (v, digits = 4) => {
  if (Number.isNaN(v)) return "—";
  const size = Math.abs(v);
  if (size !== 0 && (size < 1e-3 || size >= 1e5)) return v.toExponential(2);
  return String(Number(v.toPrecision(digits)));
};
const metres = (v) => (Number.isNaN(v) ? "—" : `${v.toFixed(v < 100 ? 1 : 0)} m`);

// ---- small builders ----
const SVG = "http://www.w3.org/2000/svg";
const draw = (parent, tag, facts) => {
  const made = document.createElementNS(SVG, tag);
  for (const [name, fact] of Object.entries(facts)) made.setAttribute(name, fact);
  parent.append(made);
  return made;
};
const cell = (text, title = "", kind = "") => {
  const made = document.createElement("td");
  made.className = kind;
  if (title && text) {
    const word = document.createElement("abbr");
    word.title = title;
    word.textContent = text;
    made.append(word);
  } else made.textContent = text;
  return made;
};
const fill = (id, lines) => {
  at(id).replaceChildren(...lines.map((cells) => {
    const row = document.createElement("tr");
    row.append(...cells);
    return row;
  }));
};
