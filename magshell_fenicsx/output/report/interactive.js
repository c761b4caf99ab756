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
  const kinds = {uint8: Uint8Array, uint16: Uint16Array, int16: Int16Array, uint32: Uint32Array, float32: Float32Array};
  const array = it => new kinds[it.kind](data, it.at, it.size);
  const scaled = it => Float32Array.from(array(it), v => it.low + it.step * v);
  const r0 = scaled(about.r0), triangles = array(about.triangles), count = r0.length / 3;
  const shifts = about.u.map(scaled);
  const each = (values, c) => { const out = new Float32Array(values.length / 3); for (let i = 0; i < out.length; i++) out[i] = values[3 * i + c]; return out; };
  const corner = (c, of = triangles) => { const out = new Uint32Array(of.length / 3); for (let i = 0; i < out.length; i++) out[i] = of[3 * i + c]; return out; };
  const state = {frame: about.opens, field: 0, factor: 1};

  const option = (select, value, text) => { const o = document.createElement("option"); o.value = value; o.innerHTML = text; select.append(o); };
  about.fields.forEach((f, i) => option(part("field"), i, f.label));
  for (const select of ["across", "up"]) for (const [name, c] of Object.entries(about.columns)) option(part(select), name, c.label);
  about.steps.forEach((s, i) => option(part("step"), i, s.title));
  if (about.steps.length > 1) option(part("step"), -1, "all steps"); else part("steps").hidden = true;
  const last = a => a[a.length - 1];
  const stepOf = frame => { // the last one that has the point as its own
    const row = about.frames[frame];
    for (let i = about.steps.length - 1; i >= 0; i--) if (about.steps[i].rows.slice(1).includes(row)) return i;
    return 0;
  };
  const choose = step => {
    part("step").value = step;
    const s = step < 0 ? last(about.steps) : about.steps[step];
    if (s) [part("across").value, part("up").value] = s.axes;
    else [part("across").value, part("up").value] = Object.keys(about.columns);
  };
  choose(stepOf(state.frame));
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
    const beside = [about.lines.flat(3), ...about.solids.flat().map(s => scaled(s.r))];
    for (const places of beside) places.forEach((v, i) => { const c = i % 3; low[c] = Math.min(low[c], v); high[c] = Math.max(high[c], v); });
    const most = Math.max(...high.map((h, c) => h - low[c]));
    return low.map((l, c) => [l - 0.03 * most, high[c] + 0.03 * most]);
  };
  const values = () => { const f = about.fields[state.field], at = f.at[Math.min(state.frame, f.at.length - 1)]; return Float32Array.from(array(at), v => f.low + (f.high - f.low) * v / 255); };
  const lamp = (() => { // from the upper left, as in the pictures
    const d = about.camera, n = Math.hypot(...d), t = d.map(v => v / n), size = Math.hypot(t[0], t[1]) || 1;
    const right = [-t[1] / size, t[0] / size, 0], up = [-t[2] * right[1], t[2] * right[0], t[0] * right[1] - t[1] * right[0]];
    const way = t.map((v, i) => 0.7 * v - 0.45 * right[i] + 0.55 * up[i]);
    return {x: -1e4 * way[0], y: -1e4 * way[1], z: -1e4 * way[2]}; // Plotly takes where the light goes
  })();
  const lighting = {ambient: 0.62, diffuse: 0.45, specular: 0.03, roughness: 0.9, facenormalsepsilon: 0, vertexnormalsepsilon: 0};
  const poles = [[0, "#5a85c7"], [0.5, "#5a85c7"], [0.5, "#cc5c54"], [1, "#cc5c54"]];
  const solids = () => about.solids[state.frame].map(s => {
    const r = scaled(s.r), of = array(s.triangles), size = Math.max(...bounds().map(b => b[1] - b[0])), d = about.camera;
    if (!s.poles.length) for (let i = 0; i < r.length; i++) r[i] += 0.008 * size * d[i % 3] / Math.hypot(...d); // what touches is not drawn in stripes
    const drawn = {type: "mesh3d", x: each(r, 0), y: each(r, 1), z: each(r, 2), i: corner(0, of), j: corner(1, of), k: corner(2, of),
      flatshading: false, lightposition: lamp, lighting, hovertemplate: `${s.name}<extra></extra>`, showscale: false};
    return s.poles.length ? {...drawn, intensity: s.poles, cmin: -1, cmax: 1, colorscale: poles} : {...drawn, color: "#8a9c9c", opacity: 0.35};
  });
  const shell = () => {
    const r = deformed(), f = about.fields[state.field];
    return {type: "mesh3d", x: each(r, 0), y: each(r, 1), z: each(r, 2), i: corner(0), j: corner(1), k: corner(2),
      intensity: values(), cmin: f.low, cmax: f.high, colorscale: f.colours.length ? f.colours : "Viridis",
      colorbar: {title: {text: f.label, side: "right"}, thickness: 12, len: 0.7, exponentformat: "power"}, flatshading: false,
      lightposition: lamp, lighting,
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
    const pane = part("shell3d"), fits = Math.min(1, 0.8 * pane.clientWidth / pane.clientHeight); // beside the colour bar
    const ratio = box.map(b => 1.3 * fits * (b[1] - b[0]) / most);
    return {xaxis: axis(box[0]), yaxis: axis(box[1]), zaxis: axis(box[2]), aspectmode: "manual",
      aspectratio: {x: ratio[0], y: ratio[1], z: ratio[2]}, uirevision: "kept",
      camera: {eye: {x: 1.6 * d[0] / n, y: 1.6 * d[1] / n, z: 1.6 * d[2] / n}, up: {x: 0, y: 0, z: 1}, projection: {type: "orthographic"}}};
  };
  const plain = {displaylogo: false, responsive: true, displayModeBar: "hover"};
  const drawShell = () => { const box = bounds(); return Plotly.react("shell3d", [shell(), ...solids(), lines(), triad(box)],
    {scene: scene(box), margin: {l: 0, r: 0, t: 0, b: 0}, uirevision: "kept", showlegend: false}, plain); };

  // The same curves as in curve.png: cubics between points, from the parameter and the slopes there (output/pictures/lines.py).
  const fine = about.segments;
  const cubics = (t, v, slopes) => {
    const out = [];
    for (let i = 0; i + 1 < t.length; i++) {
      const h = t[i + 1] - t[i], rise = v[i + 1] - v[i], first = h * slopes[i], second = h * slopes[i + 1];
      for (let k = 0; k < fine; k++) {
        const s = k / fine;
        out.push(v[i] + s * (first + s * (3 * rise - 2 * first - second + s * (first + second - 2 * rise))));
      }
    }
    out.push(last(v));
    return out;
  };

  const signed = (name, values) => values.map(v => about.columns[name].sign * v);
  const on = name => signed(name, about.columns[name].values);
  const joined = (line, name) => {
    const v = on(name), n = line.rows.length, first = n * Object.keys(about.columns).indexOf(name);
    return cubics(line.parameter, line.rows.map(i => v[i]), signed(name, array(line.slopes).subarray(first, first + n)));
  };
  const palette = ["#1f77b4", "#ff7f0e", "#9467bd", "#8c564b", "#17becf", "#7f7f7f", "#bcbd22", "#e377c2"];
  const isLocated = i => about.labels[i] === "fold" || about.labels[i] === "bifurcation";
  // As in curve.png (output/pictures/curve.py): an unstable part that its marks hide is drawn once more in an inset.
  const hiddenBelow = 16, around = 0.8, insetSize = 0.4, insetGap = 0.14, crowded = 0.02, insets = new Map();
  const limits = v => [Math.min(...v), Math.max(...v)];
  const insetOf = (pieces, curves) => { // null if all can be seen, or no corner is free
    const axes = ["x", "y"].map(c => part("curve2d")._fullLayout[`${c}axis`]);
    const inside = (c, v) => (v - axes[c].range[0]) / (axes[c].range[1] - axes[c].range[0]);
    const hidden = pieces.find(p => Math.max(...p.map((v, c) => Math.abs(inside(c, limits(v)[1]) - inside(c, limits(v)[0])) * axes[c]._length)) < hiddenBelow);
    if (!hidden) return null;
    const box = hidden.map(limits).map(([low, high]) => { const more = around * (high - low || 1e-9 * Math.abs(high) || 1e-9); return [low - more, high + more]; });
    const far = 0.97 - insetSize, corners = [[far, insetGap], [insetGap, insetGap], [far, far], [insetGap, far]];
    const points = curves.flatMap(c => c[0].map((v, i) => [inside(0, v), inside(1, c[1][i])]));
    const covered = ([left, low]) => points.filter(([u, v]) => u > left - insetGap && u < left + insetSize && v > low - insetGap && v < low + insetSize).length / points.length;
    const best = corners.reduce((a, b) => covered(b) < covered(a) ? b : a);
    if (covered(best) > crowded) return null;
    const middle = box.map(([low, high]) => (low + high) / 2), at = middle.map((v, c) => inside(c, v));
    const nearest = at.map((v, c) => Math.min(Math.max(v, best[c]), best[c] + insetSize) - v); // the place of the inset that is nearest to it
    return {box, corner: best, middle, way: [nearest[0] * axes[0]._length, -nearest[1] * axes[1]._length]};
  };
  const withInset = (traces, layout, inset) => {
    const own = (c, other) => ({domain: [inset.corner[c], inset.corner[c] + insetSize], anchor: other, range: inset.box[c], nticks: 4, tickfont: {size: 9},
      showline: true, mirror: true, linecolor: "#666", ticks: "outside", ticklen: 3, showgrid: false, zeroline: false, exponentformat: "power"});
    const again = traces.map(t => ({...t, xaxis: "x2", yaxis: "y2", showlegend: false, mode: t.mode.replace("+text", "")}));
    const frame = {type: "rect", xref: "x", yref: "y", x0: inset.box[0][0], x1: inset.box[0][1], y0: inset.box[1][0], y1: inset.box[1][1], line: {color: "#666", width: 1}};
    const leads = {x: inset.middle[0], y: inset.middle[1], xref: "x", yref: "y", text: "", showarrow: true, arrowhead: 0, arrowwidth: 0.8, arrowcolor: "#999", ax: inset.way[0], ay: inset.way[1]};
    return [[...traces, ...again], {...layout, xaxis2: own(0, "y2"), yaxis2: own(1, "x2"), shapes: [frame], annotations: [leads]}];
  };
  const drawCurve = async () => {
    const x = on(part("across").value), y = on(part("up").value), traces = [], step = +part("step").value;
    const shown = step < 0 ? about.steps : about.steps.slice(step, step + 1), dashes = {false: "solid", true: "dash"};
    const hover = i => `point ${about.points[i]}: ${about.labels[i]}${about.unstable[i] ? ", unstable" : ""}<br>%{x:.6g}, %{y:.6g}<extra></extra>`;
    const named = new Set(), once = name => { const first = !named.has(name); named.add(name); return {name, showlegend: first, legendgroup: name}; };
    const within = new Set(shown.flatMap(s => s.rows)), several = new Set(), curves = [], pieces = [];
    shown.forEach((s, n) => {
      const color = palette[n % palette.length];
      for (const l of s.lines) {
        const is = l.rows, curve = ["across", "up"].map(axis => joined(l, part(axis).value));
        curves.push(curve);
        for (const [first, end, unstable] of l.pieces) {
          const cut = v => v.slice(first * fine, end * fine + 1), name = (step < 0 ? s.title + ", " : "") + (unstable ? "unstable" : "stable");
          several.add(unstable);
          if (unstable && isLocated(is[end])) pieces.push(curve.map(cut));
          traces.push({x: cut(curve[0]), y: cut(curve[1]), mode: "lines", line: {color, width: 1.6, dash: dashes[unstable]}, hoverinfo: "skip", ...once(name)});
        }
        const dots = is.filter(i => !isLocated(i));
        traces.push({x: dots.map(i => x[i]), y: dots.map(i => y[i]), customdata: dots, mode: "markers", marker: {size: 5, color}, hovertemplate: dots.map(hover), showlegend: false});
      }
    });
    const numbers = {}; about.points.map((_, i) => i).filter(isLocated).forEach((i, n) => { numbers[i] = n + 1; });
    const marked = [...within].filter(isLocated), wide = Math.max(...x) - Math.min(...x) || 1, tall = Math.max(...y) - Math.min(...y) || 1;
    const away = (i, j) => Math.hypot((x[j] - x[i]) / wide, (y[j] - y[i]) / tall), groups = [];
    for (const i of marked) { // marks that lie on each other have one text, at the first of them
      const group = groups.find(g => away(g[0], i) < 0.03);
      group ? group.push(i) : groups.push([i]);
    }
    const text = i => {
      const some = (groups.find(g => g[0] === i) || []).map(j => numbers[j]), last = some.length - 1;
      return last > 1 && some[last] - some[0] === last ? `${some[0]}–${some[last]}` : some.join(", ");
    };
    const beside = i => { // a number stands away from the nearest other text
      const others = groups.map(g => g[0]).filter(j => j !== i);
      if (!others.length) return "top left";
      const j = others.reduce((a, b) => away(i, b) < away(i, a) ? b : a);
      return `${y[j] > y[i] ? "bottom" : "top"} ${x[j] > x[i] ? "left" : "right"}`;
    };
    for (const [kind, symbol] of [["fold", "circle-open"], ["bifurcation", "diamond-open"]]) {
      const here = [...within].filter(i => about.labels[i] === kind);
      if (here.length) traces.push({x: here.map(i => x[i]), y: here.map(i => y[i]), customdata: here, mode: "markers+text", text: here.map(text), textposition: here.map(beside),
        marker: {size: 7, symbol, color: "#d62728", line: {width: 1.5}}, hovertemplate: here.map(hover), ...once(kind)});
    }
    const found = [...within].filter(i => about.labels[i] === "solution");
    if (found.length) traces.push({x: found.map(i => x[i]), y: found.map(i => y[i]), customdata: found, mode: "markers", hovertemplate: found.map(hover),
      marker: {size: 8, symbol: found.map(i => about.unstable[i] ? "square-open" : "square"), color: "#2ca02c"}, ...once("solution")});
    const now = about.frames[state.frame];
    traces.push({x: [x[now]], y: [y[now]], mode: "markers", marker: {size: 13, color: "rgba(0,0,0,0)", line: {color: "#000", width: 2}}, hoverinfo: "skip", showlegend: false});
    const axis = name => ({title: {text: about.columns[part(name).value].label, standoff: 8}, automargin: true, zeroline: true, zerolinecolor: "#ccc", showline: true, mirror: true, ticks: "outside", showgrid: false, exponentformat: "power"});
    const layout = {xaxis: axis("across"), yaxis: axis("up"), margin: {l: 60, r: 12, t: 10, b: 45}, hovermode: "closest",
      showlegend: several.size > 1 || named.size > 1, legend: {orientation: "h", x: 0, y: 1.02, yanchor: "bottom", font: {size: 11}}};
    const draw = (...what) => Plotly.react("curve2d", ...what, {...plain, displayModeBar: false});
    const key = [part("across").value, part("up").value, step, part("curve2d").clientWidth].join();
    if (!insets.has(key)) {
      await draw(traces, layout); // which finds the ranges of the axes
      insets.set(key, insetOf(pieces, curves));
    }
    return insets.get(key) ? draw(...withInset(traces, layout, insets.get(key))) : draw(traces, layout);
  };
  const tell = () => {
    const i = about.frames[state.frame], s = about.steps[stepOf(state.frame)], c = s && about.columns[s.axes.find(n => n === s.varied)] || (s && about.columns[s.varied]);
    part("said").innerHTML = `point ${about.points[i]} (${about.labels[i]})` + (c ? `: ${c.label} = ${c.values[i].toPrecision(6)}` : "") + (about.unstable[i] ? ", unstable" : "");
  };
  const go = async frame => {
    state.frame = frame;
    part("slider").value = frame;
    const step = +part("step").value;
    if (step >= 0 && about.steps[step] && !about.steps[step].rows.includes(about.frames[frame])) choose(stepOf(frame));
    tell();
    await Promise.all([drawShell(), drawCurve()]);
  };
  tell();
  await Promise.all([drawShell(), drawCurve()]);
  part("slider").oninput = e => go(+e.target.value);
  part("field").onchange = e => { state.field = +e.target.value; drawShell(); };
  part("factor").onchange = e => { state.factor = +e.target.value; drawShell(); };
  part("across").onchange = part("up").onchange = drawCurve;
  part("step").onchange = e => { choose(+e.target.value); drawCurve(); };
  window.magshell = {about, joined, bounds}; // for tests
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
