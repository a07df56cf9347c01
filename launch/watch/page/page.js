"use strict";

// The page of skein watch. It asks the server for JSON and draws it; the server tells it when the
// list of runs has changed.

// Told apart by the colour-blind (Okabe and Ito); dashes tell apart what has one colour.
const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00"];
const DASHES = ["solid", "dash"];
const OUTCOMES = { collided: "#d55e00", timed_out: "#cc79a7", reached_end: "#0072b2" };
const OUTCOME_NAMES = { collided: "collided", timed_out: "timed out", reached_end: "reached the end" };
const MOST_COMPARED = COLOURS.length * DASHES.length;

const IMAGE = { width: 128, height: 72 };
const PLAY_PERIOD_MS = 100;

const state = {
  runs: [], chosen: [], view: "curves", curve: "walls passed", over: "episodes", course: 0, flight: 0,
  source: "recordings", follow: true, recording: null, episode: 0,
};
const view = document.getElementById("view");
let drawing = 0;

function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "class") made.className = value;
    else if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (value !== false) made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children);
  return made;
}

async function request(path, parameters = []) {
  const query = new URLSearchParams(parameters);
  const answer = await fetch(`api/${path}?${query}`);
  if (answer.ok) return answer;
  const json = await answer.json();
  throw new Error(json.error || `the server answered ${answer.status}`);
}

async function ask(path, parameters) {
  return (await request(path, parameters)).json();
}

async function askBytes(path, parameters) {
  return new Uint8Array(await (await request(path, parameters)).arrayBuffer());
}

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function layout(more) {
  const ink = colour("--ink");
  const axis = { gridcolor: colour("--line"), zerolinecolor: colour("--line"), automargin: true };
  return Object.assign({
    paper_bgcolor: colour("--paper"),
    plot_bgcolor: colour("--paper"),
    font: { color: ink, family: "system-ui, sans-serif" },
    margin: { l: 56, r: 12, t: 12, b: 48 },
    legend: { orientation: "h", y: 1.02, yanchor: "bottom" },
    showlegend: true,
    xaxis: Object.assign({}, axis, more.x),
    yaxis: Object.assign({}, axis, more.y),
    uirevision: more.uirevision || "kept",
  }, more.rest);
}

// Plotly is large: the list of runs does not wait for it.
let loading = null;

function plotly() {
  loading ??= new Promise((done, failed) => {
    const script = element("script", { src: "plotly.js", onload: () => done(), onerror: () => { loading = null; failed(new Error("plotly.js cannot be loaded")); } });
    document.head.append(script);
  });
  return loading;
}

const CONFIG = { responsive: true, displaylogo: false };

// The list of runs

function ago(seconds) {
  const passed = Math.max(0, Date.now() / 1000 - seconds);
  for (const [unit, length] of [["d", 86400], ["h", 3600], ["min", 60]]) {
    if (passed >= length) return `${Math.floor(passed / length)} ${unit} ago`;
  }
  return "now";
}

function styleOf(id) {
  const place = state.chosen.indexOf(id);
  if (place < 0) return null;
  return { colour: COLOURS[place % COLOURS.length], dash: DASHES[Math.floor(place / COLOURS.length)] };
}

function showList() {
  const filter = document.getElementById("filter").value.toLowerCase();
  const shown = state.runs.filter((run) => run.id.toLowerCase().includes(filter));
  const focused = document.activeElement && document.activeElement.value;
  const items = shown.map((run) => {
    const style = styleOf(run.id);
    const box = element("input", { type: "checkbox", value: run.id, onchange: (event) => choose(run.id, event.target.checked) });
    box.checked = style !== null;
    const swatch = element("span", { class: "swatch", "aria-hidden": "true" });
    if (style) swatch.style.background = style.colour;
    const name = element("span", { class: "name" }, run.id, element("small", {}, `${run.state} · ${ago(run.changed_secs)}`));
    return element("li", {}, element("label", {}, box, swatch, name));
  });
  const list = document.getElementById("list");
  list.replaceChildren(...items);
  for (const box of list.querySelectorAll("input")) if (box.value === focused) box.focus();
  const running = state.runs.filter((run) => run.state === "running").length;
  document.getElementById("status").textContent = state.runs.length === 0
    ? "no runs in this folder yet: they appear here by themselves"
    : `${state.runs.length} ${state.runs.length === 1 ? "run" : "runs"}, ${running} running`;
}

function choose(id, wanted) {
  state.chosen = state.chosen.filter((other) => other !== id);
  if (wanted) state.chosen.push(id);
  while (state.chosen.length > MOST_COMPARED) state.chosen.shift();
  showList();
  show();
}

function take(runs) {
  const there = new Set(runs.map((run) => run.id));
  const before = JSON.stringify(state.runs.filter((run) => state.chosen.includes(run.id)));
  state.runs = runs;
  state.chosen = state.chosen.filter((id) => there.has(id));
  if (state.chosen.length === 0 && runs.length > 0) state.chosen = [runs[0].id];
  showList();
  const now = JSON.stringify(runs.filter((run) => state.chosen.includes(run.id)));
  // A flight does not change while one looks at it from a chosen side.
  const looks = state.view === "flights" && before !== "[]" && (!state.follow || playing !== null);
  if (before !== now && !looks) show();
}

// Views

async function show() {
  const mine = ++drawing;
  const kept = view.dataset.view === state.view;
  view.setAttribute("aria-busy", "true");
  try {
    const draw = VIEWS[state.view];
    if (state.chosen.length === 0) return empty("Choose a run in the list.");
    const content = await draw(kept);
    if (mine !== drawing) return;
    if (content) {
      pause();
      view.replaceChildren(...content.nodes);
      view.dataset.view = state.view;
      view.dataset.flight = "";
      if (content.after) content.after();
    }
  } catch (error) {
    if (mine === drawing) empty(error.message, "problem");
  } finally {
    if (mine === drawing) view.setAttribute("aria-busy", "false");
  }
}

function empty(text, kind = "hint") {
  pause();
  view.replaceChildren(element("p", { class: kind }, text));
  view.dataset.view = "";
}

function select(label, options, chosen, change) {
  const box = element("select", { onchange: (event) => change(event.target.value) },
    ...options.map(([value, text]) => element("option", { value, selected: value === chosen }, text)));
  return element("label", {}, `${label} `, box);
}

const X_TITLES = { episodes: "training episodes", steps: "environment steps", minutes: "minutes since the first episode" };

async function curves(kept) {
  const [answer] = await Promise.all([ask("curves", [["curve", state.curve], ...state.chosen.map((id) => ["run", id])]), plotly()]);
  const traces = [];
  const problems = [];
  for (const id of state.chosen) {
    const curve = answer.curves[id];
    const { colour: line, dash } = styleOf(id) || {};
    if (!curve || curve.error) problems.push(`${id}: ${curve ? curve.error : "it is gone"}`);
    else traces.push({ x: curve[state.over], y: curve.values, name: id, mode: "lines", line: { color: line, dash, width: 2 } });
  }
  const names = answer.names.includes(state.curve) ? answer.names : [state.curve, ...answer.names];
  const choices = element("div", { class: "choices" },
    select("Curve", names.map((name) => [name, name]), state.curve, (value) => { state.curve = value; show(); }),
    select("over", Object.keys(X_TITLES).map((key) => [key, key]), state.over, (value) => { state.over = value; show(); }));
  const plotLayout = layout({
    x: { title: { text: X_TITLES[state.over] }, rangemode: "tozero" },
    y: { title: { text: state.curve } },
    uirevision: `${state.curve} ${state.over}`,
  });
  const old = kept && view.querySelector(".plot");
  if (old && view.dataset.names === names.join()) {
    view.querySelector(".problem").textContent = problems.join("; ");
    Plotly.react(old, traces, plotLayout, CONFIG);
    return null;
  }
  view.dataset.names = names.join();
  const plot = element("div", { class: "plot" });
  const hint = element("p", { class: "hint" }, "Walls passed, return, steps and policy lag are means of 50 training episodes; the others are TensorBoard's.");
  return {
    nodes: [choices, element("p", { class: "problem", role: "alert" }, problems.join("; ")), plot, hint],
    after: () => Plotly.newPlot(plot, traces, plotLayout, CONFIG),
  };
}

function table(titles, rows, numbers) {
  const kind = (place) => (numbers.includes(place) ? "number" : "");
  const head = element("tr", {}, ...titles.map((title, place) => element("th", { class: kind(place), scope: "col" }, title)));
  const body = rows.map((cells) => element("tr", {}, ...cells.map((cell, place) => element("td", { class: kind(place) }, cell))));
  return element("div", { class: "scroll" }, element("table", {}, element("thead", {}, head), element("tbody", {}, ...body)));
}

async function actors() {
  const nodes = [];
  for (const id of state.chosen) {
    nodes.push(element("h2", {}, id));
    let run;
    try {
      run = await ask("run", [["run", id]]);
    } catch (error) {
      nodes.push(element("p", { class: "problem" }, error.message));
      continue;
    }
    if (run.latest) {
      const [walls, reward] = run.latest.map((value) => value.toFixed(2));
      nodes.push(element("p", {}, `last 50 episodes: ${walls} walls passed, return ${reward}`));
    }
    if (run.damaged_rows > 0) nodes.push(element("p", { class: "problem" }, `episodes.csv: ${run.damaged_rows} rows cannot be read and are left out`));
    const actors = [...new Set([...Object.keys(run.actors), ...Object.keys(run.activity)])].sort((one, other) => one - other);
    const rows = actors.map((actor) => {
      const flown = run.actors[actor];
      const numbers = flown ? [`${flown.episodes}`, `${flown.steps}`, flown.walls_passed.toFixed(2), `${flown.last_episode}`] : ["0", "0", "", ""];
      const log = run.activity[actor];
      const last = log ? [ago(log.changed_secs), element("span", { class: "log" }, log.line)] : ["", "no log"];
      return [`actor ${actor}`, ...numbers, ...last];
    });
    nodes.push(rows.length === 0
      ? element("p", { class: "hint" }, "No actor has begun yet.")
      : table(["actor", "episodes", "steps", "walls passed", "its last episode", "last log line", ""], rows, [1, 2, 3, 4]));
  }
  return { nodes };
}

async function settings() {
  const runs = await Promise.all(state.chosen.map((id) => ask("run", [["run", id]]).catch((error) => ({ settings: {}, problem: error.message }))));
  const keys = [...new Set(runs.flatMap((run) => Object.keys(run.settings)))].sort();
  const differs = (key) => new Set(runs.map((run) => run.settings[key])).size > 1;
  const shown = runs.length > 1 ? [...keys.filter(differs), ...keys.filter((key) => !differs(key))] : keys;
  const rows = shown.map((key) => element("tr", { class: differs(key) ? "differs" : "" },
    element("td", {}, key), ...runs.map((run, place) => element("td", { class: "value", "data-run": state.chosen[place] }, run.settings[key] ?? "not set"))));
  const head = element("tr", {}, element("th", { scope: "col" }, "setting"), ...state.chosen.map((id) => element("th", { scope: "col" }, id)));
  const count = keys.filter(differs).length;
  const hint = runs.length > 1 ? `${count} settings differ; they stand first.` : "Choose a second run to see what differs.";
  const problems = runs.map((run) => run.problem).filter(Boolean).map((text) => element("p", { class: "problem" }, text));
  return { nodes: [element("p", { class: "hint" }, hint), ...problems,
    element("div", { class: "scroll" }, element("table", { class: "settings" }, element("thead", {}, head), element("tbody", {}, ...rows)))] };
}

// The run whose flights are shown: the one that was chosen last.
function lastChosen() {
  return state.chosen[state.chosen.length - 1];
}

async function evaluated() {
  const id = lastChosen();
  const { courses } = await ask("flights", [["run", id]]);
  if (courses.length === 0) throw new Error(`${id} has no final evaluation yet.`);
  state.course = Math.min(state.course, courses.length - 1);
  const options = courses.map((course, number) => [`${number}`, `${course.name} (${course.failed} of ${course.episodes} failed)`]);
  const choice = select("Course", options, `${state.course}`, (value) => { state.course = Number(value); state.flight = 0; show(); });
  return { id, course: courses[state.course], choice };
}

function svg(name, attributes, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

// Returns where a flight crossed a wall's front, or ended at it, [y, z].
function atWall(flight, wall) {
  const points = flight.points_m;
  for (let place = 1; place < points.length; place++) {
    const [from, to] = [points[place - 1], points[place]];
    if (from[0] < wall.x_m && to[0] >= wall.x_m) {
      const share = (wall.x_m - from[0]) / (to[0] - from[0]);
      return [1, 2].map((axis) => from[axis] + share * (to[axis] - from[axis]));
    }
  }
  const end = points[points.length - 1];
  return end[0] >= wall.x_m - 1 && end[0] < wall.x_m ? end.slice(1) : null;
}

function wallFigure(course, wall, number) {
  const [, width, height] = course.corridor_m;
  const at = ([y, z]) => [width / 2 - y, height - z];
  const text = (point) => at(point).map((value) => value.toFixed(3)).join(",");
  const ended = (flight) => flight.outcome !== "reached_end" && Math.abs(flight.points_m[flight.points_m.length - 1][0] - wall.x_m) < 1.3;
  const marks = [];
  for (const flight of [...course.flights].reverse()) {
    const point = ended(flight) ? flight.points_m[flight.points_m.length - 1].slice(1) : atWall(flight, wall);
    if (!point) continue;
    const [x, y] = at(point);
    const title = svg("title", {}, `episode ${flight.episode} ${ended(flight) ? OUTCOME_NAMES[flight.outcome] : "passed"}`);
    marks.push(ended(flight)
      ? svg("path", { d: `M${x - 0.17},${y - 0.17}l.34,.34m0,-.34l-.34,.34`, stroke: OUTCOMES[flight.outcome], "stroke-width": 0.1, fill: "none" }, title)
      : svg("circle", { cx: x, cy: y, r: 0.09, fill: OUTCOMES.reached_end, "fill-opacity": 0.6 }, title));
  }
  const failed = course.flights.filter(ended).length;
  const picture = svg("svg", { viewBox: `-0.1 -0.1 ${width + 0.2} ${height + 0.2}`, width: 190, height: 190 * height / width, role: "img",
    "aria-label": `wall ${number}: ${failed} failed here` },
    svg("rect", { width, height, fill: colour("--line"), stroke: colour("--pale"), "stroke-width": 0.06 }),
    svg("polygon", { points: wall.outline_m.map(text).join(" "), fill: colour("--paper"), stroke: colour("--pale"), "stroke-width": 0.05 }),
    ...marks);
  return element("figure", {}, picture, element("figcaption", {}, `wall ${number} at ${wall.x_m} m: ${failed} failed`));
}

async function failures() {
  const { id, course, choice } = await evaluated();
  if (!course.walls.length) return { nodes: [element("div", { class: "choices" }, choice), element("p", { class: "hint" }, `${id}: ${course.failed} of ${course.episodes} episodes failed. This course is a world of obstacles, which has no walls to draw them on: choose "Flights in 3-D".`)] };
  const figures = course.walls.map((wall, place) => wallFigure(course, wall, place + 1));
  const hint = `${id}: each wall from the front. A dot: an episode passed here; a cross: it collided or timed out within 1.3 m of the wall. Up to 60 episodes are drawn, those that failed first.`;
  return { nodes: [element("div", { class: "choices" }, choice), element("p", { class: "hint" }, hint), element("div", { class: "walls" }, ...figures)] };
}

function wallMesh(wall) {
  const points = wall.triangles_m.flat();
  const corner = (offset) => wall.triangles_m.map((_, place) => 3 * place + offset);
  return { type: "mesh3d", x: points.map((p) => p[0]), y: points.map((p) => p[1]), z: points.map((p) => p[2]),
    i: corner(0), j: corner(1), k: corner(2), color: "#8a919c", opacity: 0.45, hoverinfo: "skip", showlegend: false, flatshading: true };
}

function wayOf(points, upto) {
  const way = points.slice(0, upto + 1);
  return { x: way.map((p) => p[0]), y: way.map((p) => p[1]), z: way.map((p) => p[2]) };
}

// A plot of a flight through walls and obstacles. Its move(step) flies the drone to a step.
function scene({ corridor_m: corridor, walls: closed, obstacles_m: obstacles }, points, outcome, name) {
  const colours = { color: OUTCOMES[outcome] };
  const last = points.length - 1;
  const walls = obstacles.length > 0 ? [...closed, { triangles_m: obstacles }] : closed;
  const plot = element("div", { class: "plot" });
  const at = (step) => wayOf([points[step]], 0);
  const line = (more, upto) => Object.assign({ type: "scatter3d", mode: "lines", line: Object.assign({ width: 6 }, colours) }, more, wayOf(points, upto));
  const traces = [
    ...walls.map(wallMesh),
    line({ opacity: 0.3, hoverinfo: "skip", showlegend: false }, last),
    line({ name }, 0),
    Object.assign({ type: "scatter3d", mode: "markers", name: "drone", marker: Object.assign({ size: 7, symbol: "square" }, colours) }, at(0)),
  ];
  const [length, width, height] = corridor;
  const axis = (title, range) => ({ title: { text: title }, range, gridcolor: colour("--line"), backgroundcolor: colour("--paper") });
  const room = {
    xaxis: axis("along, m", [0, length]), yaxis: axis("left, m", [-width / 2, width / 2]), zaxis: axis("up, m", [0, height]),
    aspectmode: "manual", aspectratio: { x: 2.6, y: 0.7, z: 0.7 * height / width },
    camera: { eye: { x: -1.85, y: -2.1, z: 0.95 }, center: { x: -0.2, y: 0, z: -0.2 } },
  };
  return {
    plot, last,
    draw: () => Plotly.newPlot(plot, traces, layout({ rest: { scene: room, margin: { l: 0, r: 0, t: 0, b: 0 } } }), CONFIG),
    move: (step) => {
      const [way, drone] = [wayOf(points, step), at(step)];
      Plotly.restyle(plot, { x: [way.x, drone.x], y: [way.y, drone.y], z: [way.z, drone.z] }, [walls.length + 1, walls.length + 2]);
    },
  };
}

// Timer that plays a flight.
let playing = null;

function pause() {
  clearInterval(playing);
  playing = null;
  for (const button of document.querySelectorAll(".play")) button.textContent = "Play";
}

// Slider over the steps, and the button that plays them. Calls go(step).
function player(last, go) {
  const slider = element("input", { type: "range", min: 0, max: last, value: 0, "aria-label": "step" });
  slider.addEventListener("input", () => { pause(); go(Number(slider.value)); });
  const play = element("button", { type: "button", class: "play", onclick: () => {
    if (playing !== null) return pause();
    if (Number(slider.value) === last) slider.value = 0;
    play.textContent = "Pause";
    playing = setInterval(() => {
      slider.value = Number(slider.value) + 1;
      go(Number(slider.value));
      if (Number(slider.value) === last) pause();
    }, PLAY_PERIOD_MS);
  } }, "Play");
  return [play, slider];
}

async function flights(kept) {
  const id = lastChosen();
  const [{ recordings }] = await Promise.all([ask("recordings", [["run", id]]), plotly()]);
  const source = select(`Flights of ${id}`, [["recordings", `recorded (${recordings.length})`], ["evaluation", "final evaluation: positions alone"]],
    state.source, (value) => { state.source = value; show(); });
  if (recordings.length > 0 && state.source === "recordings") return recordedFlight(kept, id, recordings, source);
  if (recordings.length > 0) {
    return evaluationFlight([source]).catch((error) => ({ nodes: [element("div", { class: "choices" }, source), element("p", { class: "hint" }, error.message)] }));
  }
  const hint = element("p", { class: "hint" }, `${id} has no recordings. A run started with --set run.record_every=50 records each 50th training episode, `
    + "each course's first evaluation episode and those that failed, with what the camera sees and the reward.");
  try {
    const { nodes, after } = await evaluationFlight([]);
    return { nodes: [hint, ...nodes], after };
  } catch (error) {
    return { nodes: [hint, element("p", { class: "hint" }, error.message)] };
  }
}

async function evaluationFlight(choices) {
  const { course, choice } = await evaluated();
  state.flight = Math.min(state.flight, course.flights.length - 1);
  const flight = course.flights[state.flight];
  const options = course.flights.map((one, number) => [`${number}`, `${one.episode}: ${OUTCOME_NAMES[one.outcome]}`]);
  const chosen = select("Episode", options, `${state.flight}`, (value) => { state.flight = Number(value); show(); });
  const drawn = scene(course, flight.points_m, flight.outcome, `episode ${flight.episode}`);
  const where = element("output", {});
  const say = (step) => { where.textContent = ` step ${step} of ${drawn.last}: ${place(flight.points_m[step])}`; };
  const controls = player(drawn.last, (step) => { drawn.move(step); say(step); });
  say(0);
  return {
    nodes: [element("div", { class: "choices" }, ...choices, choice, chosen), element("div", { class: "choices" }, ...controls, where), drawn.plot],
    after: drawn.draw,
  };
}

function place([x, y, z]) {
  return `${x.toFixed(1)} m along, ${y.toFixed(1)} m left, ${z.toFixed(1)} m up`;
}

function picture(caption) {
  const canvas = element("canvas", Object.assign({ class: "depth", role: "img", "aria-label": caption }, IMAGE));
  const text = element("figcaption", {}, caption);
  return { canvas, text, figure: element("figure", {}, canvas, text) };
}

function drawGrey(canvas, images, step) {
  const pixels = IMAGE.width * IMAGE.height;
  const context = canvas.getContext("2d");
  const data = context.createImageData(IMAGE.width, IMAGE.height);
  for (let pixel = 0; pixel < pixels; pixel++) {
    const grey = images[step * pixels + pixel];
    data.data.set([grey, grey, grey, 255], 4 * pixel);
  }
  context.putImageData(data, 0, 0);
}

// Images that the run's decoder makes of the codes; an error says why it has none.
async function reconstruct(asked) {
  const answer = await request("reconstructions", asked);
  if (answer.headers.get("content-type") === "application/json") throw new Error((await answer.json()).none);
  return new Uint8Array(await answer.arrayBuffer());
}

function rewardPlot(steps) {
  const plot = element("div", { class: "small plot" });
  const rewards = steps.map((step) => (step.numbers.reward || [0])[0]);
  let sum = 0;
  const soFar = rewards.map((reward) => (sum += reward));
  const line = (y, name, place, more) => ({ x: rewards.map((_, step) => step), y, name, mode: "lines", line: Object.assign({ color: COLOURS[place], width: 2 }, more) });
  const now = (step) => ({ type: "line", x0: step, x1: step, y0: 0, y1: 1, yref: "paper", line: { color: colour("--pale"), width: 1, dash: "dot" } });
  const drawn = layout({ x: { title: { text: "step" } }, y: {}, rest: { margin: { l: 40, r: 8, t: 8, b: 36 }, shapes: [now(0)] } });
  return {
    plot,
    draw: () => Plotly.newPlot(plot, [line(soFar, "return so far", 0, {}), line(rewards, "reward", 1, { dash: "dash" })], drawn, { responsive: true, displayModeBar: false }),
    move: (step) => Plotly.relayout(plot, { shapes: [now(step)] }),
  };
}

// Numbers of a step that a table shows: column, its title.
const SHOWN = [["position_m", "position, m"], ["velocity_mps", "velocity, m/s"], ["action", "action"],
  ["oracle_action", "teacher's action"], ["reward_terms", "reward terms"], ["walls_passed", "walls passed"]];

function numbersTable(flight, step) {
  const { numbers } = flight.steps[step];
  const rows = SHOWN.filter(([column]) => numbers[column]).map(([column, title]) => [title, numbers[column].map((value) => (value ?? NaN).toFixed(2)).join("  ")]);
  return table(["at this step", ""], rows, [1]);
}

function outcomeOf(flight) {
  const last = flight.events.length > 0 ? flight.events[flight.events.length - 1][1] : "";
  return { "reached the end": "reached_end", "timed out": "timed_out" }[last] || "collided";
}

function recordingTitle(name) {
  const parts = /^(training|evaluation)-(?:(\d+)-)?(\d+)-(.+)-(\d+)of(\d+)\.mcap$/.exec(name);
  if (!parts) return name;
  const [, kind, evaluation, episode, outcome, passed, walls] = parts;
  return `${kind}${evaluation ? ` ${evaluation}, ` : " "}episode ${episode}: ${OUTCOME_NAMES[outcome] || outcome}, ${passed} of ${walls} walls`;
}

async function recordedFlight(kept, id, recordings, source) {
  const names = recordings.map((recording) => recording.name);
  if (!names.includes(state.recording) || state.follow) {
    if (state.recording !== names[0]) state.episode = 0;
    state.recording = names[0];
  }
  const chosen = select("Recording", names.map((name) => [name, recordingTitle(name)]), state.recording,
    (value) => { Object.assign(state, { recording: value, episode: 0, follow: value === names[0] }); show(); });
  chosen.className = "recording";
  const key = JSON.stringify([id, state.recording, state.episode]);
  if (kept && view.dataset.flight === key) {
    view.querySelector(".recording")?.replaceWith(chosen);
    return null;
  }
  const follow = element("input", { type: "checkbox", onchange: (event) => { state.follow = event.target.checked; show(); } });
  follow.checked = state.follow;
  const choices = [source, chosen, element("label", {}, follow, " follow the newest")];
  const asked = [["run", id], ["name", state.recording], ["episode", `${state.episode}`]];
  let answers;
  try {
    answers = await Promise.all([ask("recording", asked), askBytes("images", asked)]);
    if (answers[0].flight.steps.length === 0) throw new Error(`${state.recording} has no steps.`);
  } catch (error) {
    return { nodes: [element("div", { class: "choices" }, ...choices), element("p", { class: "problem" }, error.message)] };
  }
  const [{ titles, flight }, depth] = answers;
  if (titles.length > 1) choices.splice(2, 0, select("Episode", titles.map((title, number) => [`${number}`, title]), `${state.episode}`, (value) => { state.episode = Number(value); state.follow = false; show(); }));

  const points = flight.steps.map((step) => step.numbers.position_m);
  const drawn = scene(flight, points, outcomeOf(flight), flight.title);
  const [seen, coded] = [picture("depth image: brighter is farther"), picture("what the decoder makes of its latent code")];
  const rewards = rewardPlot(flight.steps);
  const where = element("output", {});
  const numbers = element("div", {});
  let reconstructed = null;
  let now = 0;
  const pictures = () => {
    drawGrey(seen.canvas, depth, now);
    if (reconstructed) drawGrey(coded.canvas, reconstructed, now);
  };
  const say = () => {
    const secs = flight.steps[now].secs;
    const event = flight.events.filter(([at]) => at <= secs + 1e-6).pop();
    where.textContent = ` step ${now} of ${drawn.last}, ${secs.toFixed(1)} s: ${event ? event[1] : ""}`;
    numbers.replaceChildren(numbersTable(flight, now));
    pictures();
  };
  const controls = player(drawn.last, (step) => { now = step; drawn.move(step); rewards.move(step); say(); });
  say();
  const side = element("div", { class: "side" }, seen.figure, coded.figure, rewards.plot, numbers);
  coded.text.textContent = "the reconstruction is being drawn";
  return {
    nodes: [element("div", { class: "choices" }, ...choices), element("div", { class: "choices" }, ...controls, where),
      element("div", { class: "flight" }, drawn.plot, side)],
    after: () => {
      view.dataset.flight = key;
      drawn.draw();
      rewards.draw();
      reconstruct(asked).then((images) => {
        reconstructed = images;
        coded.text.textContent = "what the decoder makes of its latent code";
        pictures();
      }).catch((error) => {
        coded.canvas.remove();
        coded.text.textContent = error.message;
      });
    },
  };
}

const VIEWS = { curves, actors, settings, failures, flights };

// Tabs, by pointer and by arrow keys

const tabs = [...document.querySelectorAll("[role=tab]")];

function open(tab, focus) {
  for (const other of tabs) {
    other.setAttribute("aria-selected", `${other === tab}`);
    other.tabIndex = other === tab ? 0 : -1;
  }
  if (focus) tab.focus();
  view.setAttribute("aria-labelledby", tab.id);
  state.view = tab.id.slice("tab-".length);
  history.replaceState(null, "", `#${state.view}`);
  show();
}

for (const [place, tab] of tabs.entries()) {
  tab.addEventListener("click", () => open(tab, false));
  tab.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (step) open(tabs[(place + step + tabs.length) % tabs.length], true);
  });
}

document.getElementById("filter").addEventListener("input", showList);
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", show);

const changes = new EventSource("api/changes");
changes.onmessage = (event) => take(JSON.parse(event.data));
changes.onerror = () => { document.getElementById("status").textContent = "skein watch has ended, or cannot be reached; this page waits for it"; };

const wanted = tabs.find((tab) => tab.id === `tab-${location.hash.slice(1)}`);
if (wanted) open(wanted, false);
