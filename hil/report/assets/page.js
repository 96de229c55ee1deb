"use strict";
// Draws the curves of a report with uPlot. Every curve comes as minima and maxima over bins of time; for the
// range on view they are gathered again into two points a pixel, so that a spike of one tick is always drawn.
(() => {
  const report = JSON.parse(document.getElementById("report").textContent);
  const CURVE_HEIGHT = 190, CHART_HEIGHT = 240, DASHES = [[], [6, 3], [2, 2], [8, 2, 2, 2]];

  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer;
  const colour = name => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();

  // A curve is {value} when it never changes, {low} when each bin is one tick, {low, high} otherwise.
  function decodeRun(run) {
    run.t = new Float64Array(bytes(run.t));
    for (const curve of Object.values(run.curves)) {
      if ("value" in curve) {
        curve.low = curve.high = new Float32Array(run.t.length).fill(curve.value ?? NaN);
      } else {
        curve.low = new Float32Array(bytes(curve.low));
        curve.high = curve.high ? new Float32Array(bytes(curve.high)) : curve.low;
      }
    }
    return run;
  }
  const runs = report.runs.map(decodeRun);
  const last = run => run.t.length ? run.t[run.t.length - 1] : 0;
  const whole = {min: 0, max: Math.max(1e-3, ...runs.map(last))};

  function firstAtOrAfter(t, value) {
    let low = 0, high = t.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (t[middle] < value) low = middle + 1; else high = middle;
    }
    return low;
  }

  // Two values a column of pixels: undefined joins (nothing there), null breaks (a gap, or no number).
  function gather(run, curve, view, columns) {
    const t = run.t, out = new Array(2 * columns).fill(undefined), width = (view.max - view.min) / columns;
    const from = Math.max(0, firstAtOrAfter(t, view.min) - 1);
    const to = Math.min(t.length, firstAtOrAfter(t, view.max) + 1);
    for (let i = from; i < to; i++) {
      const column = Math.min(columns - 1, Math.max(0, Math.floor((t[i] - view.min) / width)));
      const low = curve.low[i], high = curve.high[i], at = 2 * column;
      if (!Number.isFinite(low) || !Number.isFinite(high)) {
        if (out[at] === undefined) out[at] = out[at + 1] = null;
      } else if (out[at] == null) {
        out[at] = low; out[at + 1] = high;
      } else {
        out[at] = Math.min(out[at], low); out[at + 1] = Math.max(out[at + 1], high);
      }
      if (i > 0 && column > 0 && t[i] - t[i - 1] > run.gap && out[at - 1] === undefined) out[at - 1] = null;
    }
    return out;
  }

  function gathered(plot, view, columns) {
    const width = (view.max - view.min) / columns, x = new Array(2 * columns);
    for (let i = 0; i < 2 * columns; i++) x[i] = view.min + (i + 0.5) * width / 2;
    return [x, ...plot.curves.map(c => gather(runs[c.run], runs[c.run].curves[c.key], view, columns))];
  }

  const axis = more => ({
    stroke: () => colour("soft"), grid: {stroke: () => colour("line"), width: 1},
    ticks: {stroke: () => colour("line"), width: 1}, font: "12px system-ui, sans-serif", ...more,
  });
  const short = v => v == null ? "–" : v !== 0 && (Math.abs(v) >= 1e6 || Math.abs(v) < 1e-3)
    ? v.toExponential(3).replace(/\.?0+e/, "e") : String(+v.toPrecision(6));
  const shorts = (u, splits) => splits.map(v => v == null ? "" : short(v));

  function horizontalLines(u, lines) {
    const ctx = u.ctx, {left, top, width, height} = u.bbox;
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = colour("bad");
    ctx.textAlign = "left";
    ctx.setLineDash([5 * devicePixelRatio, 4 * devicePixelRatio]);
    ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
    for (const [value, name] of lines) {
      const y = u.valToPos(value, "y", true);
      if (!(y >= top - 1 && y <= top + height + 1)) continue;
      ctx.beginPath(); ctx.moveTo(left, y); ctx.lineTo(left + width, y); ctx.stroke();
      if (name) ctx.fillText(name, left + 4 * devicePixelRatio, y + 12 * devicePixelRatio);
    }
    ctx.restore();
  }

  // A line at each event; in the plot of the states its kind, too, where there is room.
  function eventLines(u, named) {
    const ctx = u.ctx, {left, top, width, height} = u.bbox, px = devicePixelRatio;
    let free = -Infinity;
    ctx.save();
    ctx.font = `${10 * px}px system-ui, sans-serif`;
    ctx.textAlign = "left";
    for (const run of runs) for (const event of run.events) {
      const x = u.valToPos(event.t, "x", true);
      if (!(x >= left && x <= left + width)) continue;
      ctx.strokeStyle = ctx.fillStyle = colour(event.kind === "state" ? "soft" : "bad");
      ctx.globalAlpha = 0.6;
      ctx.setLineDash([2, 4]);
      ctx.beginPath(); ctx.moveTo(x, top); ctx.lineTo(x, top + height); ctx.stroke();
      if (!named || x < free) continue;
      free = x + 12 * px;
      const after = x + 12 * px < left + width;
      ctx.globalAlpha = 1;
      ctx.translate(x + (after ? 10 : -3) * px, top + height - 6 * px); ctx.rotate(-Math.PI / 2);
      ctx.fillText(event.kind, 0, 0);
      ctx.rotate(Math.PI / 2); ctx.translate(-x - (after ? 10 : -3) * px, -top - height + 6 * px);
    }
    ctx.restore();
  }

  // What happened where the pointer is.
  const nearText = document.getElementById("near");
  function tellNear(u) {
    const found = [];
    for (const run of u.cursor.left >= 0 ? runs : []) for (const event of run.events) {
      if (Math.abs(u.valToPos(event.t, "x") - u.cursor.left) < 5)
        found.push(`${short(event.t)} s ${event.kind}: ${event.text}`);
    }
    nearText.textContent = found.slice(0, 3).join("; ") + (found.length > 3 ? `; and ${found.length - 3} more` : "");
  }

  function verticalRange(plot) {
    if (plot.names.length) return () => [-0.5, plot.names.length - 0.5];
    return (u, min, max) => {
      const shown = plot.lines.filter(() => plot.fit).map(line => line[0]);
      min = Math.min(min ?? Infinity, ...shown); max = Math.max(max ?? -Infinity, ...shown);
      if (!(min <= max)) return [0, 1];
      const room = 0.06 * (max - min) || 0.05 * Math.abs(max) || 1;
      return [min - room, max + room];
    };
  }

  const charts = [];
  let view = {...whole};
  const earlier = [];
  const range = document.getElementById("range");

  function show(min, max, remember = true) {
    min = Math.max(whole.min, min); max = Math.min(whole.max, max);
    if (!(max - min > 1e-9)) return;
    if (remember) earlier.push(view);
    view = {min, max};
    for (const chart of charts) redraw(chart);
    range.textContent = `${short(min)} to ${short(max)} s`;
    document.getElementById("back").disabled = earlier.length === 0;
  }

  function redraw({plot, u}) {
    const columns = Math.max(50, Math.round(u.bbox.width / devicePixelRatio));
    u.batch(() => {
      u.setData(gathered(plot, view, columns), false);
      u.setScale("x", view);
    });
  }

  const back = () => { if (earlier.length) { const was = earlier.pop(); show(was.min, was.max, false); } };
  const reset = () => { if (view.min !== whole.min || view.max !== whole.max) show(whole.min, whole.max); };

  function makeCurves(plot) {
    const card = document.getElementById("plot-" + plot.key);
    const path = plot.held ? uPlot.paths.stepped({align: 1}) : undefined;
    const u = new uPlot({
      width: card.clientWidth, height: CURVE_HEIGHT,
      cursor: {
        // The others follow the pointer, but only the plot that was dragged across sets the range.
        sync: {key: "time", setSeries: false, filters: {pub: kind => !["mousedown", "mouseup"].includes(kind)}},
        drag: {x: true, y: false, setScale: false}, points: {size: 5},
        bind: {dblclick: () => reset},
      },
      scales: {x: {time: false, range: (u, min, max) => [min, max]}, y: {range: verticalRange(plot)}},
      axes: [
        axis({values: shorts}),
        axis({size: plot.names.length ? 150 : 64, values: plot.names.length
          ? (u, splits) => splits.map(s => plot.names[s] ?? "") : shorts,
          ...(plot.names.length ? {splits: () => plot.names.map((_, i) => i)} : {})}),
      ],
      series: [
        {label: "t [s]", value: (u, v) => short(v)},
        ...plot.curves.map(c => ({
          label: c.label, stroke: () => colour("c" + c.colour), width: 1.25, dash: DASHES[c.dash], paths: path,
          points: {show: false},
          value: (u, v) => plot.names.length && v != null ? plot.names[v] ?? String(v) : short(v),
        })),
      ],
      hooks: {
        draw: [u => { eventLines(u, plot.key === "state"); horizontalLines(u, plot.lines); }],
        setCursor: [tellNear],
        setSelect: [u => {
          if (u.select.width < 3) return;
          const min = u.posToVal(u.select.left, "x"), max = u.posToVal(u.select.left + u.select.width, "x");
          u.setSelect({left: 0, top: 0, width: 0, height: 0}, false);
          show(min, max);
        }],
      },
    }, [[whole.min, whole.max], ...plot.curves.map(() => [null, null])], card);
    charts.push({plot, u});
  }

  // Histograms and spectra: curves over their own logarithmic axis.
  const others = [];
  function makeChart(chart) {
    const card = document.getElementById("chart-" + chart.key);
    const steps = chart.steps ? uPlot.paths.stepped({align: 1}) : undefined;
    others.push(new uPlot({
      width: card.clientWidth, height: CHART_HEIGHT,
      cursor: {drag: {x: true, y: false}},
      scales: {
        x: {time: false, distr: 3},
        y: {distr: 3, range: (u, min, max) => max > 0
          ? [chart.steps ? 0.1 : 10 ** Math.floor(Math.log10(min)), 10 ** Math.ceil(Math.log10(max) + 0.01)] : [0.1, 10]},
      },
      axes: [axis({label: chart.x, labelSize: 18, size: 34, values: shorts}), axis({size: 70, values: shorts})],
      series: [
        {label: chart.x, value: (u, v) => short(v)},
        ...chart.curves.map(c => ({
          label: c.label, stroke: () => colour("c" + c.colour), width: 1.25, paths: steps, points: {show: false},
          fill: chart.steps && chart.curves.length === 1 ? () => colour("band") : undefined,
          value: (u, v) => short(chart.steps && v < 1 ? 0 : v),
        })),
      ],
    }, uPlot.join(chart.curves.map(c => [c.xs, c.ys])), card));
  }

  report.plots.forEach(makeCurves);
  report.charts.forEach(makeChart);
  const cards = document.getElementById("plots");
  document.getElementById("back").onclick = back;
  document.getElementById("all").onclick = reset;
  for (const button of document.querySelectorAll("button[data-t]")) {
    button.onclick = () => {
      const t = Number(button.dataset.t), half = Number(button.dataset.span) / 2;
      show(t - half, t + half);
      cards.scrollIntoView();
    };
  }
  const fit = () => {
    for (const {u} of charts) u.setSize({width: u.root.parentNode.clientWidth, height: CURVE_HEIGHT});
    for (const u of others) u.setSize({width: u.root.parentNode.clientWidth, height: CHART_HEIGHT});
    show(view.min, view.max, false);
  };
  const repaint = () => { for (const u of [...charts.map(c => c.u), ...others]) u.redraw(); };
  addEventListener("resize", fit);
  addEventListener("beforeprint", () => { fit(); repaint(); });
  addEventListener("afterprint", () => { fit(); repaint(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
  show(whole.min, whole.max, false);
  window.hilReport = {charts, others, show, get view() { return view; }};  // for tests, and for the console
})();
