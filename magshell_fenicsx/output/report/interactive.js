"use strict";
(async () => {
  const about = JSON.parse(document.getElementById("about").textContent);
  const part = name => document.getElementById(name);
  const unpacked = async name => {
    const bytes = Uint8Array.from(atob(part(name).textContent.trim()), c => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Response(stream).arrayBuffer();
  };
  try {
    (0, eval)(new TextDecoder().decode(await unpacked("library")));
  } catch (e) {
    part("said").textContent = "This browser cannot unpack the view; a current one can.";
    throw e;
  }
  const data = await unpacked("shells");
  const kinds = {uint8: Uint8Array, uint16: Uint16Array, int16: Int16Array, uint32: Uint32Array};
  const array = it => new kinds[it.kind](data, it.at, it.size);
  const scaled = it => Float32Array.from(array(it), v => it.low + it.step * v);
  const r0 = scaled(about.r0), triangles = array(about.triangles), count = r0.length / 3;
  const shifts = about.u.map(scaled);
  const each = (values, c) => { const out = new Float32Array(count); for (let i = 0; i < count; i++) out[i] = values[3 * i + c]; return out; };
  const corner = c => { const out = new Uint32Array(triangles.length / 3); for (let i = 0; i < out.length; i++) out[i] = triangles[3 * i + c]; return out; };
  const signed = [[0, "#053061"], [0.1, "#2166ac"], [0.2, "#4393c3"], [0.3, "#92c5de"], [0.4, "#d1e5f0"], [0.5, "#ffffff"],
    [0.6, "#fddbc7"], [0.7, "#f4a582"], [0.8, "#d6604d"], [0.9, "#b2182b"], [1, "#67001f"]];
  const state = {frame: about.opens, field: 0, factor: 1};

  const option = (select, value, text) => { const o = document.createElement("option"); o.value = value; o.innerHTML = text; select.append(o); };
  about.fields.forEach((f, i) => option(part("field"), i, f.label));
  for (const select of ["across", "up"]) for (const [name, c] of Object.entries(about.columns)) option(part(select), name, c.label);
  [part("across").value, part("up").value] = about.axes;
  part("slider").max = about.frames.length - 1;
  part("slider").value = state.frame;

  const deformed = () => { const u = shifts[state.frame], r = new Float32Array(r0.length); for (let i = 0; i < r.length; i++) r[i] = r0[i] + state.factor * u[i]; return r; };
  const bounds = () => {
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (const u of shifts) for (let i = 0; i < r0.length; i++) {
      const v = r0[i] + state.factor * u[i], c = i % 3;
      if (v < low[c]) low[c] = v;
      if (v > high[c]) high[c] = v;
    }
    about.lines.flat(2).forEach((v, i) => { const c = i % 3; low[c] = Math.min(low[c], v); high[c] = Math.max(high[c], v); });
    const most = Math.max(...high.map((h, c) => h - low[c]));
    return low.map((l, c) => [l - 0.03 * most, high[c] + 0.03 * most]);
  };
  const values = () => { const f = about.fields[state.field], at = f.at[Math.min(state.frame, f.at.length - 1)]; return Float32Array.from(array(at), v => f.low + (f.high - f.low) * v / 255); };
  const shell = () => {
    const r = deformed(), f = about.fields[state.field];
    return {type: "mesh3d", x: each(r, 0), y: each(r, 1), z: each(r, 2), i: corner(0), j: corner(1), k: corner(2),
      intensity: values(), cmin: f.low, cmax: f.high, colorscale: f.low < 0 ? signed : "Viridis",
      colorbar: {title: {text: f.label, side: "right"}, thickness: 12, len: 0.7, exponentformat: "power"}, flatshading: false,
      lightposition: {x: -1e4 * about.camera[0], y: -1e4 * about.camera[1], z: -1e4 * about.camera[2]},
      lighting: {ambient: 0.72, diffuse: 0.28, specular: 0.03, roughness: 0.9, facenormalsepsilon: 0, vertexnormalsepsilon: 0},
      hovertemplate: "%{intensity:.4g}<extra></extra>"};
  };
  const lines = () => {
    const x = [], y = [], z = [];
    for (const line of about.lines[state.frame]) { for (const p of line) { x.push(p[0]); y.push(p[1]); z.push(p[2]); } x.push(null); y.push(null); z.push(null); }
    return {type: "scatter3d", mode: "lines", x, y, z, line: {color: "#444", width: 3}, hoverinfo: "skip", showlegend: false};
  };
  const triad = box => {
    const o = box.map(b => b[0]), size = 0.15 * Math.max(...box.map(b => b[1] - b[0]));
    const x = [], y = [], z = [], text = [];
    for (let c = 0; c < 3; c++) {
      const end = o.map((v, i) => v + (i === c ? size : 0));
      [o, end].forEach((p, k) => { x.push(p[0]); y.push(p[1]); z.push(p[2]); text.push(k ? `e<sub>${c + 1}</sub>` : ""); });
      x.push(null); y.push(null); z.push(null); text.push("");
    }
    return {type: "scatter3d", mode: "lines+text", x, y, z, text, line: {color: "#000", width: 3}, hoverinfo: "skip", showlegend: false};
  };
  const scene = box => {
    const most = Math.max(...box.map(b => b[1] - b[0])), d = about.camera, n = Math.hypot(...d);
    const axis = b => ({visible: false, range: b, autorange: false});
    const ratio = box.map(b => 1.3 * (b[1] - b[0]) / most);
    return {xaxis: axis(box[0]), yaxis: axis(box[1]), zaxis: axis(box[2]), aspectmode: "manual",
      aspectratio: {x: ratio[0], y: ratio[1], z: ratio[2]}, uirevision: "kept",
      camera: {eye: {x: 1.6 * d[0] / n, y: 1.6 * d[1] / n, z: 1.6 * d[2] / n}, up: {x: 0, y: 0, z: 1}, projection: {type: "orthographic"}}};
  };
  const plain = {displaylogo: false, responsive: true, displayModeBar: "hover"};
  const drawShell = () => { const box = bounds(); return Plotly.react("shell3d", [shell(), lines(), triad(box)],
    {scene: scene(box), margin: {l: 0, r: 0, t: 0, b: 0}, uirevision: "kept", showlegend: false}, plain); };

  const on = name => { const sign = about.signs[name] ?? 1; return about.columns[name].values.map(v => sign * v); };
  const label = name => ((about.signs[name] ?? 1) < 0 ? "− " : "") + about.columns[name].label;
  const drawCurve = () => {
    const x = on(part("across").value), y = on(part("up").value), traces = [];
    const rows = about.points.map((_, i) => i);
    for (const branch of new Set(about.branches)) {
      const own = rows.filter(i => about.branches[i] === branch && about.labels[i] !== "solution");
      if (!own.length) continue;
      traces.push({x: own.map(i => x[i]), y: own.map(i => y[i]), customdata: own, mode: "lines+markers", line: {color: "#1f77b4", width: 1.5},
        marker: {size: 5, color: own.map(i => about.unstable[i] ? "#ffffff" : "#1f77b4"), line: {color: "#1f77b4", width: 1}}, showlegend: false,
        hovertemplate: own.map(i => `point ${about.points[i]}: ${about.labels[i]}<br>%{x:.6g}, %{y:.6g}<extra></extra>`)});
    }
    const located = rows.filter(i => about.labels[i] === "fold" || about.labels[i] === "bifurcation");
    traces.push({x: located.map(i => x[i]), y: located.map(i => y[i]), customdata: located, mode: "markers+text", text: located.map((_, n) => `${n + 1}`),
      textposition: "top left", marker: {size: 9, color: "#d62728"}, hovertemplate: located.map(i => `${about.labels[i]}<br>%{x:.6g}, %{y:.6g}<extra></extra>`), showlegend: false});
    const found = rows.filter(i => about.labels[i] === "solution");
    traces.push({x: found.map(i => x[i]), y: found.map(i => y[i]), customdata: found, mode: "markers", marker: {size: 8, symbol: "square", color: "#2ca02c"}, showlegend: false});
    const now = about.frames[state.frame];
    traces.push({x: [x[now]], y: [y[now]], mode: "markers", marker: {size: 13, color: "rgba(0,0,0,0)", line: {color: "#000", width: 2}}, hoverinfo: "skip", showlegend: false});
    const axis = name => ({title: {text: label(part(name).value), standoff: 8}, zeroline: true, zerolinecolor: "#ccc", showline: true, mirror: true, ticks: "outside", showgrid: false, exponentformat: "power"});
    return Plotly.react("curve2d", traces, {xaxis: axis("across"), yaxis: axis("up"), margin: {l: 70, r: 15, t: 10, b: 55}, hovermode: "closest"}, {...plain, displayModeBar: false});
  };
  const tell = () => {
    const i = about.frames[state.frame], c = about.columns[about.varied];
    part("said").innerHTML = `point ${about.points[i]} (${about.labels[i]})` + (c ? `: ${c.label} = ${c.values[i].toPrecision(6)}` : "") + (about.unstable[i] ? ", unstable" : "");
  };
  const go = async frame => { state.frame = frame; part("slider").value = frame; tell(); await Promise.all([drawShell(), drawCurve()]); };
  tell();
  await Promise.all([drawShell(), drawCurve()]);
  part("slider").oninput = e => go(+e.target.value);
  part("field").onchange = e => { state.field = +e.target.value; drawShell(); };
  part("factor").onchange = e => { state.factor = +e.target.value; drawShell(); };
  part("across").onchange = part("up").onchange = drawCurve;
  part("curve2d").on("plotly_click", e => {
    const row = e.points[0].customdata;
    if (row === undefined) return;
    let best = 0;
    about.frames.forEach((f, k) => { if (Math.abs(f - row) < Math.abs(about.frames[best] - row)) best = k; });
    go(best);
  });
  let playing = 0;
  part("play").onclick = () => {
    if (playing) { clearInterval(playing); playing = 0; part("play").textContent = "play"; return; }
    part("play").textContent = "stop";
    playing = setInterval(() => go((state.frame + 1) % about.frames.length), 350);
  };
  document.body.dataset.ready = "yes";
})();
