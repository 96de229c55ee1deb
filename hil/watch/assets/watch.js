"use strict";
// Live plots of a run from the WebSocket beside this page. The next run comes by itself; the next server has
// another address: nothing is asked with this one's token once it has gone, since anybody may have its port.
(() => {
  const KEPT_S = 30, HEIGHT = 190;
  const get = id => document.getElementById(id);
  const colour = name => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
  const token = location.pathname.split("/")[1]; // the address is the key
  let plotted = []; // [title, [[key, label], ...]] of each plot, as the run says
  let kept = {t: []}, plots = [], socket = null, asked = false;

  function build() {
    plots.forEach(plot => plot.chart.destroy());
    const axis = {stroke: colour("soft"), grid: {stroke: colour("line"), width: 1}, ticks: {stroke: colour("line")}};
    const places = plotted.map(() => document.createElement("div")); // all there before one is measured
    places.forEach(place => { place.className = "plot"; });
    get("plots").replaceChildren(...places);
    plots = plotted.map(([title, curves], n) => {
      const place = places[n];
      const series = curves.map(([, label], i) =>
        ({label, stroke: colour("c" + i), width: 1.4, points: {show: false}}));
      const chart = new uPlot({title, width: place.clientWidth, height: HEIGHT, series: [{label: "s"}, ...series],
        scales: {x: {time: false}}, axes: [{...axis}, {...axis, size: 60}], cursor: {sync: {key: "hil"}}},
        [[], ...curves.map(() => [])], place);
      return {chart, place, keys: curves.map(([key]) => key)};
    });
  }

  function draw() {
    for (const {chart, keys} of plots) chart.setData([kept.t, ...keys.map(key => kept[key] ?? [])]);
    document.body.dataset.points = kept.t.length;
    document.body.dataset.last = kept.t.at(-1) ?? "";
  }

  function take(curves) {
    const last = kept.t.at(-1);
    if (last > curves.t[0]) { // the first data after coming back hold what is here already
      const from = curves.t.findIndex(t => t > last);
      if (from < 0) return;
      for (const key in curves) curves[key] = curves[key].slice(from);
    }
    const gap = last !== undefined && curves.t[0] - last > 0.25; // missed data: break the line
    const end = curves.t.at(-1) - KEPT_S;
    const drop = Math.max(0, kept.t.findIndex(t => t >= end));
    for (const key in curves) {
      const old = (kept[key] ?? []).slice(drop);
      if (gap) old.push(key === "t" ? (last + curves.t[0]) / 2 : null);
      kept[key] = old.concat(curves[key]);
    }
    draw();
  }

  const number = (value, digits, unit) => value == null ? "–" : value.toFixed(digits) + " " + unit;
  function show(now) {
    get("state").textContent = now.state.replaceAll("_", " ") + (now.reason ? ": " + now.reason.replaceAll("_", " ") : "");
    get("state").className = now.state === "operation_enabled" ? "good" : now.state.startsWith("fault") ? "bad" : "warn";
    if (now.silent) {
      get("state").textContent = `no tick for ${now.age_s.toFixed(1)} s: the loop hangs or is stopped`;
      get("state").className = "bad";
    }
    const late = now.lateness_us ?? {};
    const rows = {tick: now.k, speed: number(now.w, 2, "rad/s"), reference: number(now.w_ref, 2, "rad/s"),
      "load estimate": number(now.T_L_hat, 2, "N m"), "DC link": number(now.v_dc, 0, "V"),
      rate: number(now.rate_hz, 0, "Hz"), "late p50 / p99 / max": `${late.p50} / ${late.p99} / ${late.max} us`,
      "skipped (1 s)": now.skipped, dropped: now.dropped};
    get("figures").replaceChildren(...Object.entries(rows).map(([name, value]) => {
      const box = document.createElement("div"), dt = document.createElement("dt"), dd = document.createElement("dd");
      dt.textContent = name; dd.textContent = value; box.append(dt, dd);
      return box;
    }));
  }

  function list(events) {
    get("events").replaceChildren(...events.reverse().map(cells => {
      const row = document.createElement("tr");
      for (const cell of cells) row.insertCell().textContent = cell;
      return row;
    }));
  }

  function on(message) {
    if (message.run) {
      kept = {t: []}; asked = false;
      const node = message.run.node ? `node ${message.run.node}, ` : "";
      get("run").textContent = `${node}PID ${message.run.pid} on ${message.run.bus}, log ${message.run.log}`;
      get("note").textContent = "";
      get("stop").disabled = false;
      takes(message.run.takes?.w);
      plotted = message.run.plots;
      build();
      draw();
    }
    if (message.status) idle(message.status);
    if (message.note) get("note").textContent = message.note;
    if (message.now) show(message.now);
    if (message.curves) { list(message.events); take(message.curves); }
  }

  function takes(range) {
    get("setpoint").hidden = !range;
    if (!range) return;
    get("w").min = range[0]; get("w").max = range[1];
    get("w").title = `${range[0]} to ${range[1]} rad/s, at ${range[2]} rad/s²`;
  }

  function idle(text) {
    get("state").textContent = text;
    get("state").className = "";
    get("stop").disabled = true;
    get("setpoint").hidden = true;
  }

  function connect() {
    socket = new WebSocket(`ws://${location.host}/${token}/live`);
    socket.onmessage = event => on(JSON.parse(event.data));
    socket.onclose = () => idle("the connection has ended: open the address that hil watch --web prints");
  }

  function set() {
    const value = get("w").valueAsNumber;
    if (socket.readyState !== WebSocket.OPEN || !Number.isFinite(value)) return;
    socket.send(JSON.stringify({set: {w: value}, token}));
  }

  get("set").onclick = set;
  get("w").onkeydown = event => { if (event.key === "Enter") set(); };
  get("stop").onclick = () => {
    if (asked || socket.readyState !== WebSocket.OPEN) return;
    asked = true;
    get("stop").disabled = true;
    socket.send(JSON.stringify({stop: token}));
  };
  addEventListener("resize", () => plots.forEach(({chart, place}) => chart.setSize({width: place.clientWidth, height: HEIGHT})));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { build(); draw(); });
  connect();
})();
