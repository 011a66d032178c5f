"use strict";
const scene = JSON.parse(document.getElementById("scene").textContent);
const byId = (id) => document.getElementById(id);
const darkness = matchMedia("(prefers-color-scheme: dark)");
const narrow = () => innerWidth < 600;
const KINDS = {
  accepted: { name: "accepted", colours: ["#1a7f37", "#3fb950"], symbol: "circle", shown: true },
  pending: { name: "pending", colours: ["#8a5d00", "#d29922"], symbol: "diamond", shown: true },
  rejected: { name: "rejected by the pose graph", colours: ["#cf222e", "#ff7b72"], symbol: "x", shown: true },
  false: { name: "false", colours: ["#a8236b", "#f778ba"], symbol: "star", shown: true },
  missed: { name: "missed revisit", colours: ["#7a45d6", "#bc8cff"], symbol: "circle-open", shown: true },
  tested: { name: "rejected by the verification", colours: ["#57606a", "#9aa4af"], symbol: "triangle-up-open", shown: "legendonly" },
};
const BUTTONS = [["zoom2d", "pan2d", "resetScale2d", "toImage"]];
const CURVES = { "ground truth": ["#24292f", "#c9d1d9"], odometry: ["#b85c00", "#f0a04b"], optimised: ["#1f6fb4", "#58a6ff"] };
let selected = -1;

function colour(name) { return getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim(); }
function curveColour(name) { return CURVES[name][darkness.matches ? 1 : 0]; }
function kindColour(kind) { return KINDS[kind].colours[darkness.matches ? 1 : 0]; }
function markSize(count) { return (narrow() ? 7 : 8) - (count > 50) - (count > 150) - (narrow() && count > 50); }
function share(value) { return value === null || value === undefined ? undefined : value.toFixed(2); }
function layout(extra) {
  const axis = { gridcolor: colour("line"), zerolinecolor: colour("line"), linecolor: colour("line"), automargin: true };
  const base = {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: colour("text"), size: 12 },
    margin: { l: 48, r: 12, t: 8, b: 40 }, legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 },
    hoverlabel: { align: "left", bgcolor: colour("card"), bordercolor: colour("quiet"), font: { color: colour("text") } }, modebar: { orientation: "v", bgcolor: "rgba(0,0,0,0)", color: colour("quiet"), activecolor: colour("accent") }, dragmode: narrow() ? "pan" : "zoom",
  };
  const made = { ...base, ...extra };
  for (const key of Object.keys(made)) if (/^[xy]axis/.test(key)) made[key] = { ...axis, ...made[key], title: { text: made[key].title, standoff: 6 } };
  return made;
}
function draw(id, traces, extra) {
  return Plotly.react(id, traces, layout(extra), { responsive: true, displaylogo: false, displayModeBar: narrow() || id !== "trajectory" ? false : "hover", modeBarButtons: BUTTONS, scrollZoom: id === "trajectory" });
}
function hide(id, when) { byId(id).classList.toggle("hidden", when); }
function seconds(index) { return scene.keyframes.t[index]; }
function title(pair) {
  const what = pair.number ? `closure ${pair.number}, ${KINDS[pair.kind].name}` : KINDS[pair.kind].name;
  return `${what}: ${seconds(pair.q).toFixed(1)} s, match ${(seconds(pair.q) - seconds(pair.m)).toFixed(1)} s earlier`;
}

function drawTrajectory() {
  const traces = scene.curves.map((curve) => ({
    mode: "lines", name: curve.name, x: curve.xyz[0], y: curve.xyz[1], hoverinfo: "skip",
    line: { color: curveColour(curve.name), width: curve.name === "optimised" ? 2 : 1.4 },
  }));
  const xy = scene.keyframes.xy;
  if (!scene.curves.length && xy.length) {
    traces.push({ mode: "lines", name: "keyframes by time (no poses)", x: xy.map((p) => p[0]), y: xy.map((p) => p[1]), hoverinfo: "skip", line: { color: colour("quiet"), width: 1 } });
  }
  for (const [kind, style] of Object.entries(KINDS)) {
    const mine = scene.pairs.map((pair, i) => [pair, i]).filter(([pair]) => pair.kind === kind);
    if (!mine.length) continue;
    const x = [], y = [];
    for (const [pair] of mine) { x.push(xy[pair.q][0], xy[pair.m][0], null); y.push(xy[pair.q][1], xy[pair.m][1], null); }
    traces.push({ mode: "lines", x, y, hoverinfo: "skip", showlegend: false, legendgroup: kind, visible: style.shown,
      line: { color: kindColour(kind), width: kind === "accepted" ? 1 : 1.6, dash: kind === "missed" || kind === "tested" ? "dot" : "solid" } });
    traces.push({ mode: "markers", name: `${style.name} (${mine.length})`, legendgroup: kind, visible: style.shown,
      x: mine.map(([pair]) => xy[pair.q][0]), y: mine.map(([pair]) => xy[pair.q][1]), customdata: mine.map(([, i]) => i),
      text: mine.map(([pair]) => title(pair) + (pair.p === null ? "" : `<br>probability ${pair.p}`) + (pair.graph ? `<br>pose graph: ${pair.graph}` : "")),
      hoverinfo: "text", marker: { color: kindColour(kind), symbol: style.symbol, size: markSize(mine.length), line: { color: kindColour(kind), width: 1.2 } } });
  }
  const pair = scene.pairs[selected];
  if (pair) {
    traces.push({ mode: "lines+markers", showlegend: false, hoverinfo: "skip", x: [xy[pair.q][0], xy[pair.m][0]], y: [xy[pair.q][1], xy[pair.m][1]],
      line: { color: colour("text"), width: 3 }, marker: { color: "rgba(0,0,0,0)", size: 17, line: { color: colour("text"), width: 2.5 } } });
  }
  const map = scene.map;
  const images = map && byId("map").checked ? [{ source: map.address, xref: "x", yref: "y", x: map.lower[0], y: map.upper[1],
    sizex: map.upper[0] - map.lower[0], sizey: map.upper[1] - map.lower[1], sizing: "stretch", layer: "below", opacity: 0.75 }] : [];
  draw("trajectory", traces, { images, uirevision: "kept", hovermode: "closest", xaxis: { title: "x [m]", constrain: "domain" },
    yaxis: { title: "y [m]", scaleanchor: "x", constrain: "domain" } });
}

function row(table, name, value, className) {
  if (value === undefined || value === null || value === "") return;
  const line = table.insertRow();
  line.insertCell().textContent = name;
  const cell = line.insertCell();
  cell.textContent = value;
  if (className) cell.className = className;
}
function drawPair() {
  const pair = scene.pairs[selected];
  hide("detail", !pair);
  if (!pair) return;
  byId("pair-title").textContent = title(pair);
  byId("pair-mark").style.color = kindColour(pair.kind);
  const table = byId("pair-facts");
  table.replaceChildren();
  row(table, "reason", pair.why);
  row(table, "would accept it", pair.parameter);
  row(table, "probability", pair.p);
  row(table, "similarity", share(pair.s));
  row(table, "pose graph", pair.graph);
  row(table, "ground truth", pair.truth, pair.truth.startsWith("FALSE") ? "bad" : pair.truth.startsWith("true") ? "good" : "");
  if (pair.pose) row(table, "relative pose", `${pair.shift_m} m, ${pair.turn_deg} deg, by ${pair.pose_source}`);
  row(table, "details", `${scene.explain} ${pair.stamps[0]} ${pair.stamps[1]}`, "code");
  drawViews(pair);
  drawScans(pair);
  drawBars(pair);
}
function loaded(address) {
  return new Promise((resolve) => { const image = new Image(); image.onload = () => resolve(image); image.src = address; });
}
async function drawViews(pair) {
  const photos = pair.stamps.map((stamp) => scene.photographs[stamp]);
  hide("pair-pictures", !photos[0] || !photos[1]);
  if (!photos[0] || !photos[1]) return;
  const images = await Promise.all(photos.map((photo) => loaded(photo[0])));
  if (scene.pairs[selected] !== pair) return;
  const canvas = byId("views"), width = canvas.parentElement.clientWidth, stacked = width < 440, gap = 4;
  const each = stacked ? width : (width - gap) / 2, scale = each / photos[0][1], height = photos[0][2] * scale;
  const ratio = devicePixelRatio || 1;
  canvas.width = width * ratio; canvas.height = (stacked ? 2 * height + gap : height) * ratio;
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  const offset = stacked ? [0, height + gap] : [each + gap, 0];
  pen.drawImage(images[0], 0, 0, each, height);
  pen.drawImage(images[1], offset[0], offset[1], each, height);
  (pair.inliers || []).forEach(([u0, v0, u1, v1], i, all) => {
    const ends = [[u0 * scale, v0 * scale], [offset[0] + u1 * scale, offset[1] + v1 * scale]];
    pen.strokeStyle = pen.fillStyle = `hsl(${(360 * i) / all.length} 90% 60%)`;
    pen.globalAlpha = 0.65; pen.beginPath(); pen.moveTo(...ends[0]); pen.lineTo(...ends[1]); pen.stroke();
    pen.globalAlpha = 1;
    for (const end of ends) { pen.beginPath(); pen.arc(...end, 2, 0, 7); pen.fill(); }
  });
  const order = stacked ? "above: query, below: match" : "left: query, right: match";
  byId("views-caption").textContent = `${order}; ${pair.inlier_count ?? "no"} image features agree with the pose`;
}
function pointsOf(stamp) {
  if (!scene.scans[stamp]) return [];
  const bytes = Uint8Array.from(atob(scene.scans[stamp]), (letter) => letter.charCodeAt(0));
  const numbers = new Int16Array(bytes.buffer), points = [];
  for (let i = 0; i + 2 < numbers.length; i += 3) points.push([numbers[i], numbers[i + 1], numbers[i + 2]].map((n) => n * scene.scan_unit_m));
  return points;
}
function drawScans(pair) {
  const [query, match] = pair.stamps.map(pointsOf);
  hide("pair-scans", !query.length && !match.length);
  if (!query.length && !match.length) return;
  const pose = pair.pose, moved = pose ? query.map((p) => [0, 1, 2].map((r) => pose[4 * r] * p[0] + pose[4 * r + 1] * p[1] + pose[4 * r + 2] * p[2] + pose[4 * r + 3])) : query;
  const trace = (points, axis, name, tint, shown) => ({ mode: "markers", name, x: points.map((p) => p[0]), y: points.map((p) => p[axis]), hoverinfo: "skip",
    marker: { size: 3, color: tint }, showlegend: shown });
  const range = (axis) => {
    const sorted = [...match, ...moved].map((p) => p[axis]).sort((a, b) => a - b), at = (share) => sorted[Math.round(share * (sorted.length - 1))];
    return [at(0.01) - 1, at(0.99) + 1];
  };
  const view = (id, axis, label, shown) => draw(id, [trace(match, axis, "match", curveColour("optimised"), shown), trace(moved, axis, "query", curveColour("odometry"), shown)],
    { xaxis: { title: axis === 2 ? "forward [m]" : "", range: range(0) }, yaxis: { title: label, range: range(axis), ...(axis === 1 ? { scaleanchor: "x" } : {}) }, margin: { l: 44, r: 8, t: 4, b: axis === 2 ? 36 : 20 } });
  view("scans-above", 1, "left [m]", true);
  view("scans-side", 2, "up [m]", false);
  byId("scans-caption").textContent = pose ? `scans from above and from the side, aligned by ${pair.pose_source}` : "scans from above and from the side, not aligned: no pose available";
}
function wrapped(text, width) {
  const lines = [""];
  for (const word of text.split(" ")) if ((lines.at(-1) + word).length > width) lines.push(word); else lines.push((lines.pop() + " " + word).trim());
  return lines.join("<br>");
}
function meaning(criterion, values) {
  return Object.entries(scene.measurements[criterion] || {}).map(([name, text]) => wrapped(`${name}${name in values ? " = " + values[name] : ""}: ${text}`, 48)).join("<br>");
}
function drawBars(pair) {
  hide("pair-bars", !pair.bars || !pair.bars.length);
  if (!pair.bars || !pair.bars.length) return;
  const bars = pair.bars.slice(0, 14).reverse(), names = bars.map((bar) => bar[0].replaceAll("_", " "));
  const explained = bars.map((bar) => meaning(bar[0], pair.values));
  const sum = pair.bars.reduce((total, bar) => total + bar[1], 0);
  byId("bars-caption").textContent = `Log-odds: sum of the measurements ${sum.toFixed(1)}, bias ${pair.bias.toFixed(1)}; grey: missing to a measurement's maximum. Point at a bar for its measurement.`;
  byId("bars").style.height = 40 + 22 * bars.length + "px";
  draw("bars", [
    { type: "bar", orientation: "h", y: names, x: bars.map((bar) => bar[1]), name: "given", marker: { color: bars.map((bar) => kindColour(bar[1] < 0 ? "rejected" : "accepted")) }, text: explained, textposition: "none", hovertemplate: "%{y}: %{x}<br>%{text}<extra></extra>" },
    { type: "bar", orientation: "h", y: names, x: bars.map((bar) => bar[2]), name: "missing", marker: { color: "rgba(128,128,128,.35)" }, text: explained, textposition: "none", hovertemplate: "%{y}: %{x} missing<br>%{text}<extra></extra>" },
  ], { barmode: "stack", showlegend: false, xaxis: { title: "log-odds" }, yaxis: { title: "", dtick: 1, tickfont: { size: 11 } }, margin: { l: 10, r: 8, t: 4, b: 36 } });
}

function rates(threshold) {
  let found = 0, right = 0, judged = 0, revisits = 0, closed = 0;
  for (const [p, same, revisit] of scene.sweep) {
    revisits += revisit;
    if (p < threshold || p === 0) continue;
    found += 1; judged += same >= 0; right += same === 1; closed += revisit && same === 1;
  }
  return { found, right, judged, revisits, closed, precision: judged ? right / judged : null, recall: revisits ? closed / revisits : null };
}
function drawSweep() {
  hide("sweep-section", !scene.sweep.length);
  if (!scene.sweep.length) return;
  const steps = Array.from({ length: 200 }, (_, i) => i / 200).concat([0.9975, 0.999, 0.9999]);
  const all = steps.map(rates), now = Number(byId("threshold").value), here = rates(now);
  const percent = (share) => (share === null ? "unknown" : (100 * share).toFixed(1) + " %");
  const asRun = Math.abs(now - scene.threshold) < 0.003 ? " (as in this run)" : "";
  byId("threshold-words").textContent = here.judged || here.revisits
    ? `threshold ${now.toFixed(3)}${asRun}: ${here.found} closures, precision ${percent(here.precision)}, recall ${percent(here.recall)} (${here.closed} of ${here.revisits} revisits)`
    : `threshold ${now.toFixed(3)}${asRun}: ${here.found} closures, no ground truth`;
  const traces = all.some((one) => one.judged) ? [
    { mode: "lines", name: "precision", x: steps, y: all.map((one) => one.precision), line: { color: kindColour("accepted"), width: 5 } },
    { mode: "lines", name: "recall", x: steps, y: all.map((one) => one.recall), line: { color: curveColour("optimised"), width: 2 } },
  ] : [{ mode: "lines", name: "closures", x: steps, y: all.map((one) => one.found), line: { color: curveColour("optimised"), width: 2 } }];
  draw("sweep", traces, { xaxis: { title: "verification.min_probability", range: [0, 1.01] }, yaxis: { title: "", rangemode: "tozero" },
    shapes: [{ type: "line", x0: now, x1: now, yref: "paper", y0: 0, y1: 1, line: { color: colour("accent"), width: 2 } }] });
}

function drawTimeline() {
  const frames = scene.keyframes, traces = [];
  traces.push({ mode: "lines", name: "best similarity", x: frames.t, y: frames.similarity, line: { color: curveColour("optimised"), width: 1.3 } });
  for (const kind of ["accepted", "pending", "rejected", "false", "missed"]) {
    const mine = scene.pairs.map((pair, i) => [pair, i]).filter(([pair]) => pair.kind === kind);
    if (mine.length) traces.push({ mode: "markers", name: KINDS[kind].name, x: mine.map(([pair]) => seconds(pair.q)), y: mine.map(([pair]) => pair.p ?? 0), customdata: mine.map(([, i]) => i),
      text: mine.map(([pair]) => title(pair)), hoverinfo: "text", marker: { color: kindColour(kind), symbol: KINDS[kind].symbol, size: 7 } });
  }
  const timed = frames.latency.some((value) => value !== null);
  if (timed) traces.push({ mode: "lines", name: "ms per keyframe", x: frames.t, y: frames.latency, yaxis: "y2", line: { color: colour("quiet"), width: 1 } });
  draw("timeline", traces, { hovermode: "closest", xaxis: { title: "time [s]", anchor: timed ? "y2" : "y" }, yaxis: { title: "similarity, probability", range: [0, 1.06], domain: timed ? [0.36, 1] : [0, 1] },
    ...(timed ? { yaxis2: { title: "ms", domain: [0, 0.28], rangemode: "tozero" } } : {}) });
}
function drawErrors() {
  hide("errors-section", !scene.errors);
  if (!scene.errors) return;
  draw("errors", Object.entries(scene.errors).map(([name, [x, y]]) => ({ mode: "lines", name, x, y, line: { color: curveColour(name), width: 2 } })),
    { xaxis: { title: "path length [m]" }, yaxis: { title: "error [m]", rangemode: "tozero" } });
}
function drawSimilarity() {
  const matrix = scene.similarity;
  hide("similarity-section", !matrix);
  if (!matrix) return;
  const t = matrix.rows.map(seconds);
  const hundredths = Int8Array.from(atob(matrix.data), (letter) => letter.charCodeAt(0));
  const z = t.map((_, row) => Float32Array.from(hundredths.subarray(row * t.length, (row + 1) * t.length), (n) => n / 100));
  draw("similarity", [{ type: "heatmap", x: t, y: t, z, zsmooth: t.length > 100 ? "fast" : false, colorscale: "Viridis", zmin: 0, zmax: 1,
    colorbar: { thickness: 12, outlinewidth: 0 }, hovertemplate: "%{x} s and %{y} s: similarity %{z:.2f}<extra></extra>" }],
    { xaxis: { title: "time [s]", constrain: "domain" }, yaxis: { title: "time [s]", scaleanchor: "x", constrain: "domain" } });
}

function select(index, scroll) {
  selected = index;
  if (index >= 0) history.replaceState(null, "", "#pair=" + index);
  drawTrajectory();
  drawPair();
  if (scroll && byId("detail").getBoundingClientRect().top < 0 || scroll && innerWidth <= 900) byId("detail").scrollIntoView({ behavior: "smooth" });
}
function asked() {
  const index = Number(/^#pair=(\d+)$/.exec(location.hash)?.[1] ?? -1);
  return index < scene.pairs.length ? index : -1;
}
function step(by) { if (scene.pairs.length) select((selected + by + scene.pairs.length) % scene.pairs.length, false); }
function clicked(event) { const index = event.points.map((point) => point.customdata).find((one) => one !== undefined); if (index !== undefined) select(index, true); }
function pause() { return new Promise((resolve) => setTimeout(resolve)); }
const FIRST = [drawTrajectory, drawPair], REST = [drawErrors, drawSweep, drawTimeline, drawSimilarity];
async function drawAll(parts) { for (const part of parts) { part(); await pause(); } }
async function start() {
  const library = await fetch(byId("library").textContent);
  const script = document.createElement("script");
  script.textContent = await new Response(library.body.pipeThrough(new DecompressionStream("gzip"))).text();
  document.head.append(script);
  await drawAll(FIRST);
  byId("trajectory").on("plotly_click", clicked);
  document.body.dataset.interactive = "yes";
  await drawAll(REST);
  byId("timeline").on("plotly_click", clicked);
  document.body.dataset.ready = "yes";
}

hide("map-choice", !scene.map);
byId("threshold").value = scene.threshold;
byId("map").onchange = drawTrajectory;
byId("threshold").oninput = drawSweep;
byId("before").onclick = () => step(-1);
byId("after").onclick = () => step(1);
addEventListener("keydown", (event) => { if (event.target.tagName !== "INPUT" && { ArrowLeft: -1, ArrowRight: 1 }[event.key]) step({ ArrowLeft: -1, ArrowRight: 1 }[event.key]); });
darkness.addEventListener("change", () => drawAll([...FIRST, ...REST]));
addEventListener("resize", () => drawPair());
addEventListener("hashchange", () => { if (asked() >= 0) select(asked(), true); });
selected = asked() >= 0 ? asked() : scene.opened;
start().catch((error) => { byId("trajectory").textContent = `The plots cannot be drawn in this browser: ${error.message}`; });
