"use strict";

// Draws the figures of the report from its data, and links them: one time is shown in all of them.
(async () => {
  const element = (id) => document.getElementById(id);

  // ---------------------------------------------------------------------------------------------- data

  async function unpack(id) {
    const packed = Uint8Array.from(atob(element(id).textContent), (letter) => letter.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    return new Response(stream).text();
  }

  const library = document.createElement("script");
  library.textContent = await unpack("plotly");
  document.head.append(library);
  const data = JSON.parse(await unpack("data"));
  const column = (place) => (Array.isArray(place) ? place : data.columns[place]);
  const frames = column(data.frames);
  const paths = new Map(data.paths.map((path) => [path.name, path]));

  const state = { focus: data.headline, colour: "", frame: 0, kept: false };

  // The place in ascending numbers that is nearest to a value.
  function nearest(values, value) {
    let low = 0;
    let high = values.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (values[middle] <= value) low = middle;
      else high = middle;
    }
    return Math.abs(values[high] - value) < Math.abs(values[low] - value) ? high : low;
  }

  // ---------------------------------------------------------------------------------------------- looks

  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim() || "#888";
  const slug = (kind) => kind.toLowerCase().replaceAll(" ", "-");
  const config = { responsive: true, displayModeBar: false };
  // A finger that is drawn over a figure scrolls the page.
  const dragmode = matchMedia("(pointer: coarse)").matches ? false : "zoom";

  function paintKeys() {
    for (const key of document.querySelectorAll("i.key")) key.style.background = colour(key.classList[1]);
  }

  function axis(title, more = {}) {
    return {
      title: { text: title, standoff: 4 }, gridcolor: colour("grid"), linecolor: colour("line"), zeroline: false,
      automargin: true, ...more,
    };
  }

  function layout(more) {
    return {
      paper_bgcolor: colour("page"), plot_bgcolor: colour("page"), autosize: true, dragmode,
      font: { color: colour("ink"), size: 11, family: getComputedStyle(document.body).fontFamily },
      margin: { l: 56, r: 8, t: 8, b: 40 }, hoverlabel: { bgcolor: colour("raised"), font: { color: colour("ink") } },
      legend: { orientation: "h", x: 0, y: 1, yanchor: "bottom" }, ...more,
    };
  }

  function faded(name, opacity) {
    const [r, g, b] = colour(name).match(/\w\w/g).map((digits) => parseInt(digits, 16));
    return `rgba(${r},${g},${b},${opacity})`;
  }

  // The events of a kind as one shape, however many there are.
  function shades() {
    const kinds = Map.groupBy
      ? Map.groupBy(data.events, (event) => event.kind)
      : data.events.reduce((map, event) => map.set(event.kind, [...(map.get(event.kind) ?? []), event]), new Map());
    return [...kinds].map(([kind, events]) => ({
      type: "path", layer: "below", xref: "x", yref: "paper",
      path: events.map(({ start, end }) => `M${start},0L${start},1L${end},1L${end},0Z`).join(""),
      fillrule: "nonzero", fillcolor: faded(slug(kind), 0.18), line: { width: 1, color: faded(slug(kind), 0.28) },
    }));
  }

  // ---------------------------------------------------------------------------------------------- figures

  // What plotly draws for a line of a figure: a band has two edges.
  function traces(line, row) {
    const shown = {
      name: line.name, x: column(line.x), y: column(line.y), xaxis: "x", yaxis: row ? `y${row + 1}` : "y",
      showlegend: line.legend, legendgroup: line.name, visible: !line.only || line.only === state.focus, connectgaps: false,
    };
    if (line.mode === "bars") return [{ ...shown, type: "bar", marker: { color: colour(line.style) } }];
    if (line.mode === "markers") {
      const marker = { color: colour(line.style), size: 6, symbol: line.style === "fault" ? "x" : "circle" };
      return [{ ...shown, type: "scatter", mode: "markers", marker }];
    }
    const beside = line.name.includes("sigma") || line.name.includes("bounds");
    const drawn = {
      ...shown, type: "scatter", mode: line.mode === "points" ? "lines+markers" : "lines", ...(beside ? { hoverinfo: "skip" } : {}),
      line: { color: colour(line.style), width: beside ? 1 : 1.4, dash: line.dash },
    };
    if (line.mode !== "band") return [drawn];
    const middle = line.middle === null ? null : column(line.middle);
    const edge = (sign) => shown.y.map((half, i) => (half === null ? null : (middle ? middle[i] : 0) + sign * half));
    return [{ ...drawn, y: edge(1) }, { ...drawn, y: edge(-1), fill: "tonexty", fillcolor: faded(line.style, 0.12) }];
  }

  // Labels of whole decades, at most four of them; of 1, 2 and 5 where there are few.
  function decades(row) {
    const values = row.lines.flatMap((line) => column(line.y)).filter((value) => value > 0);
    const [low, high] = values.reduce(([least, most], value) => [Math.min(least, value), Math.max(most, value)], [Infinity, 0]);
    const span = Math.log10(high / low);
    return span > 1.5 ? { dtick: Math.ceil(span / 4) } : span > 0.5 ? { dtick: "D2" } : { nticks: 5 };
  }

  function drawFigure(figure) {
    const holder = document.querySelector(`#${figure.key} .plot`);
    const count = figure.rows.length;
    const gap = 0.07 / Math.max(count - 1, 1) + 0.015;
    const height = (1 - gap * (count - 1)) / count;
    const axes = {};
    figure.rows.forEach((row, i) => {
      const top = 1 - i * (height + gap);
      axes[i ? `yaxis${i + 1}` : "yaxis"] = axis(row.label, {
        domain: [Math.max(top - height, 0), top], type: row.log ? "log" : "linear",
        exponentformat: "power", ...(row.log ? decades(row) : { nticks: 5 }), rangemode: figure.rows[i].lines.some((line) => line.mode === "bars") ? "tozero" : "normal",
      });
    });
    const bottom = count > 1 ? `y${count}` : "y";
    const last = frames[frames.length - 1];
    const x = figure.timed
      ? { range: state.range ?? [frames[0] - 0.01 * last, 1.01 * last] }
      : { type: figure.rows[0].lines.some((line) => line.mode === "bars") ? "category" : "linear" };
    return Plotly.react(
      holder,
      figure.rows.flatMap((row, i) => row.lines.flatMap((line) => traces(line, i))),
      layout({
        ...axes, xaxis: axis(figure.xlabel, { anchor: bottom, ...x }), hovermode: "x unified",
        shapes: figure.timed ? shades() : [], uirevision: "keep",
      }),
      config,
    );
  }

  // ---------------------------------------------------------------------------------------------- trajectories

  const places = (path) => column(path.t).map((t) => [t, nearest(frames, t)]);
  const hover = "t = %{customdata[0]:.2f} s, frame %{customdata[1]}";

  function pathTraces(make) {
    const valued = state.colour in paths.get(state.focus);
    const traces = data.paths.map((path) => make(path, path.label, path.name, valued && path.name === state.focus));
    if (data.truth) traces.unshift(make(data.truth, "ground truth", "truth", false));
    return traces;
  }

  // Numbers as colours: blue to yellow, which the colour-blind and a grey printer can tell apart, too.
  function scale(path, size) {
    return {
      color: column(path[state.colour]), colorscale: "Cividis", size, showscale: true,
      colorbar: { title: { text: state.colour === "error" ? "error [m]" : "sigma [m]", side: "right" }, thickness: 10, len: 0.8 },
    };
  }

  // Lines from where each loop begins to where it ends on the chosen trajectory, dotted where it was not believed.
  function loopTraces(names, type) {
    const path = paths.get(state.focus);
    const t = column(path.t);
    const axes = Object.entries(names);
    const one = (believed) => {
      const loops = data.loops.filter(({ used }) => used.includes(path.name) === believed);
      const times = loops.flatMap(({ from, to }) => [from, to, null]);
      const along = ([name, read]) => [name, times.map((time) => (time === null ? null : read(path, nearest(t, time))))];
      const line = { color: colour("loops"), width: type === "scatter3d" ? 3 : 1.2, dash: believed ? "solid" : "dot" };
      return {
        ...Object.fromEntries(axes.map(along)), type, mode: "lines+markers", hoverinfo: "skip", line, marker: { size: 3, color: colour("loops") },
        name: believed ? "loops" : "loops, not believed", visible: loops.length > 0,
      };
    };
    return data.loops.length ? [one(true), one(false)] : [];
  }

  // GNSS positions of the antenna: rings, and crosses where they were not believed.
  function fixTraces(type, ends) {
    const flat = type === "scatter";
    return data.fixes.map((fixes) => {
      const name = fixes.used ? "GNSS" : "GNSS, not believed";
      const ink = colour(fixes.used ? "gnss" : "fault");
      const symbol = fixes.used ? "circle-open" : flat ? "x" : "diamond"; // not every font has the cross in space
      return {
        type, mode: "markers", name, ...ends(fixes), customdata: places(fixes), hovertemplate: `${name}<br>${hover}<extra></extra>`,
        marker: { color: ink, size: flat ? 7 : 4, symbol, line: { width: fixes.used ? 1.5 : 0, color: ink } },
      };
    });
  }

  // Where all begin, a ring, and where each ends, a square of its colour: as in trajectories.png.
  function endTraces() {
    const mark = (name, path, i, symbol, ink) => ({
      type: "scatter", mode: "markers", name, x: [column(path.x).at(i)], y: [column(path.z).at(i)], hoverinfo: "skip",
      marker: { symbol, size: 9, color: colour("page"), line: { color: ink, width: 2 } }, showlegend: path === data.paths[0],
    });
    const ends = data.paths.map((path) => mark("end", path, -1, "square", colour(path.name)));
    return [mark("start", data.paths[0], 0, "circle", colour("ink")), ...ends];
  }

  function drawMap() {
    const traces = pathTraces((path, name, style, valued) => ({
      type: "scatter", name, x: column(path.x), y: column(path.z), customdata: places(path),
      hovertemplate: `${name}<br>${hover}<extra></extra>`, mode: valued ? "markers" : "lines",
      line: { color: colour(style), width: style === "truth" ? 1.2 : 2, dash: style === "raw" ? "dash" : "solid" },
      ...(valued ? { marker: scale(path, 5) } : {}),
    }));
    traces.push(...loopTraces({ x: (path, i) => column(path.x)[i], y: (path, i) => column(path.z)[i] }, "scatter"));
    traces.push(...fixTraces("scatter", (fixes) => ({ x: column(fixes.x), y: column(fixes.z) })), ...endTraces());
    return Plotly.react(document.querySelector("#map .plot"), traces, layout({
      xaxis: axis("x, right of the first camera [m]"), yaxis: axis("z, ahead [m]", { scaleanchor: "x" }),
      hovermode: "closest", uirevision: "keep",
    }), config);
  }

  // Equal scales in a box that is no thinner than a tenth of its length.
  function box() {
    const all = [...data.paths, ...(data.truth ? [data.truth] : [])];
    const ends = ["x", "z", "y"].map((name) => {
      const values = all.flatMap((path) => column(path[name])).map((value) => (name === "y" ? -value : value));
      return values.reduce(([low, high], value) => [Math.min(low, value), Math.max(high, value)], [Infinity, -Infinity]);
    });
    const longest = Math.max(...ends.map(([low, high]) => high - low), 1e-6);
    const spans = ends.map(([low, high]) => Math.max(1.05 * (high - low), 0.1 * longest));
    const ranges = ends.map(([low, high], i) => [(low + high - spans[i]) / 2, (low + high + spans[i]) / 2]);
    // As large as fits whatever its shape, with room for the labels.
    const size = (matchMedia("(max-width: 700px)").matches ? 1.5 : 1.75) / Math.hypot(...spans);
    const [x, y, z] = spans.map((span) => size * span);
    return { ranges, aspectratio: { x, y, z } };
  }

  function drawSpace() {
    const traces = pathTraces((path, name, style, valued) => ({
      type: "scatter3d", name, x: column(path.x), y: column(path.z), z: column(path.y).map((down) => -down),
      customdata: places(path), hovertemplate: `${name}<br>${hover}<extra></extra>`, mode: valued ? "markers" : "lines",
      line: { color: colour(style), width: style === "truth" ? 2 : 4 }, ...(valued ? { marker: scale(path, 3) } : {}),
    }));
    const inSpace = { x: (path, i) => column(path.x)[i], y: (path, i) => column(path.z)[i], z: (path, i) => -column(path.y)[i] };
    traces.push(...loopTraces(inSpace, "scatter3d"));
    traces.push(...fixTraces("scatter3d", (fixes) => ({ x: column(fixes.x), y: column(fixes.z), z: column(fixes.y).map((down) => -down) })));
    const here = spot();
    traces.push({
      type: "scatter3d", mode: "markers", x: [here.x], y: [here.z], z: [-here.y], hoverinfo: "skip", showlegend: false,
      marker: { color: colour("ink"), size: 6, symbol: "circle-open", line: { width: 3 } },
    });
    const { ranges, aspectratio } = box();
    const side = (title, range, length) => ({ title: { text: title }, range, nticks: Math.max(2, Math.round(5 * length)), gridcolor: colour("grid"), backgroundcolor: colour("page"), color: colour("ink"), zerolinecolor: colour("line") });
    return Plotly.react(document.querySelector("#space .plot"), traces, layout({
      margin: { l: 0, r: 0, t: 8, b: 0 },
      scene: {
        xaxis: side("right [m]", ranges[0], aspectratio.x), yaxis: side("ahead [m]", ranges[1], aspectratio.y), zaxis: side("up [m]", ranges[2], aspectratio.z),
        aspectmode: "manual", aspectratio, dragmode: "turntable", camera: { eye: { x: -0.7, y: -1.4, z: 1.3 }, projection: { type: "orthographic" } },
      },
      uirevision: "keep",
    }), config);
  }

  // ---------------------------------------------------------------------------------------------- the cursor

  // Where the chosen trajectory is at the time of the cursor.
  function spot() {
    const path = paths.get(state.focus);
    const i = nearest(column(path.t), frames[state.frame]);
    const value = (name) => (name in path ? column(path[name])[i] : null);
    return { x: value("x"), y: value("y"), z: value("z"), error: value("error"), sigma: value("sigma") };
  }

  function overlay(plot, name) {
    let mark = plot.querySelector(`:scope > .${name}`);
    if (!mark) {
      mark = document.createElement("div");
      mark.className = name;
      plot.append(mark);
    }
    return mark;
  }

  function markTime(plot, seconds) {
    const { xaxis, _size: size } = plot._fullLayout;
    const left = xaxis._offset + xaxis.l2p(seconds);
    const inside = left >= size.l - 1 && left <= size.l + size.w + 1;
    Object.assign(overlay(plot, "cursor").style, {
      display: inside ? "block" : "none", left: `${left}px`, top: `${size.t}px`, height: `${size.h}px`,
    });
  }

  function markPlace() {
    const plot = document.querySelector("#map .plot");
    const { xaxis, yaxis } = plot._fullLayout;
    const { x, z } = spot();
    Object.assign(overlay(plot, "place").style, {
      left: `${xaxis._offset + xaxis.l2p(x)}px`, top: `${yaxis._offset + yaxis.l2p(z)}px`,
    });
  }

  function markSpace() {
    const plot = document.querySelector("#space .plot");
    const { x, y, z } = spot();
    Plotly.restyle(plot, { x: [[x]], y: [[z]], z: [[-y]] }, [plot.data.length - 1]);
  }

  function tell() {
    const here = spot();
    const seconds = frames[state.frame];
    const number = (value, digits) => (value === null ? "-" : value.toFixed(digits).replace(/^-(0\.0*)$/, "$1"));
    const stamp = BigInt(data.startNs) + BigInt(Math.round(seconds * 1e6)) * 1000n;
    const rows = [
      ["time", `${seconds.toFixed(3)} s`], ["frame", state.frame], ["stamp", `${(stamp / 1000000000n).toString()}.${(stamp % 1000000000n).toString().padStart(9, "0").slice(0, 3)} s`],
      [`position, ${paths.get(state.focus).label}`, `${number(here.x, 2)}, ${number(here.y, 2)}, ${number(here.z, 2)} m`],
      ["position error", here.error === null ? "-" : `${number(here.error, 3)} m`], ["stated sigma", here.sigma === null ? "-" : `${number(here.sigma, 3)} m`],
      ["events", data.events.filter(({ start, end }) => start <= seconds && seconds <= end).map(({ kind }) => kind).filter((kind, i, all) => all.indexOf(kind) === i).join(", ") || "-"],
    ];
    element("values").replaceChildren(...rows.map(([name, value]) => {
      const entry = document.createElement("div");
      const [term, said] = [document.createElement("dt"), document.createElement("dd")];
      term.textContent = name;
      said.textContent = value;
      entry.append(term, said);
      return entry;
    }));
    if (data.thumbnails.length) {
      const shown = data.thumbnails[nearest(data.thumbnails.map(({ t }) => t), seconds)];
      element("image").src = `data:image/jpeg;base64,${shown.jpeg}`;
      element("image").title = `image of ${shown.t.toFixed(2)} s`;
      element("image").hidden = false;
    }
    element("time").value = state.frame;
    document.body.dataset.seconds = seconds.toFixed(3);
  }

  let waiting = 0;
  function showCursor() {
    cancelAnimationFrame(waiting);
    waiting = requestAnimationFrame(() => {
      for (const plot of timePlots()) markTime(plot, frames[state.frame]);
      markPlace();
      markSpace();
      tell();
    });
  }

  function goTo(seconds) {
    state.frame = nearest(frames, seconds);
    showCursor();
  }

  const timePlots = () => document.querySelectorAll("figure.time .js-plotly-plot");

  function keep(seconds) {
    state.kept = !state.kept;
    document.body.classList.toggle("kept", state.kept);
    goTo(seconds);
  }

  function linkTime(plot) {
    const under = (event) => {
      const { xaxis } = plot._fullLayout;
      return xaxis.p2l(event.clientX - plot.getBoundingClientRect().left - xaxis._offset);
    };
    plot.addEventListener("mousemove", (event) => {
      if (!state.kept && !event.buttons) goTo(under(event));
    });
    plot.on("plotly_click", (event) => keep(event.points[0].x));
    // Zooming one zooms all.
    plot.on("plotly_relayout", (change) => {
      const range = change["xaxis.autorange"] ? null : change["xaxis.range"] ?? (("xaxis.range[0]" in change) ? [change["xaxis.range[0]"], change["xaxis.range[1]"]] : undefined);
      if (range === undefined) return;
      const last = frames[frames.length - 1];
      const wanted = range ?? [frames[0] - 0.01 * last, 1.01 * last];
      if (state.range && Math.abs(state.range[0] - wanted[0]) + Math.abs(state.range[1] - wanted[1]) < 1e-9) return;
      state.range = wanted;
      for (const other of timePlots()) {
        if (other !== plot || range === null) Plotly.relayout(other, { "xaxis.range": [...wanted] });
      }
    });
    plot.on("plotly_afterplot", () => markTime(plot, frames[state.frame]));
  }

  function linkPlace(plot) {
    const time = (event) => event.points[0].customdata?.[0];
    plot.on("plotly_hover", (event) => {
      if (!state.kept && time(event) !== undefined) goTo(time(event));
    });
    plot.on("plotly_click", (event) => {
      if (time(event) !== undefined) keep(time(event));
    });
  }

  // ---------------------------------------------------------------------------------------------- all of it

  const breathe = () => new Promise((resolve) => setTimeout(resolve, 0));

  async function drawAll() {
    paintKeys();
    await drawMap();
    await drawSpace();
    for (const figure of data.figures) {
      await drawFigure(figure);
      await breathe();
    }
    showCursor();
  }

  for (const [name, path] of paths) {
    element("focus").add(new Option(path.label, name, name === state.focus, name === state.focus));
  }
  for (const option of element("colour").options) {
    option.disabled = option.value !== "" && !data.paths.some((path) => option.value in path);
  }
  element("time").max = frames.length - 1;

  await drawAll();
  for (const plot of timePlots()) linkTime(plot);
  linkPlace(document.querySelector("#map .plot"));
  linkPlace(document.querySelector("#space .plot"));
  document.querySelector("#map .plot").on("plotly_afterplot", markPlace);

  element("focus").addEventListener("change", ({ target }) => { state.focus = target.value; drawAll(); });
  element("colour").addEventListener("change", async ({ target }) => {
    state.colour = target.value;
    await drawMap();
    await drawSpace();
    showCursor();
  });
  element("time").addEventListener("input", ({ target }) => goTo(frames[Number(target.value)]));
  for (const row of document.querySelectorAll("tr[data-seconds]")) {
    row.addEventListener("click", () => goTo(Number(row.dataset.seconds)));
  }
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawAll);
  matchMedia("print").addEventListener("change", drawAll);
  addEventListener("beforeprint", () => {
    for (const plot of document.querySelectorAll(".js-plotly-plot")) Plotly.Plots.resize(plot);
  });
  document.body.dataset.ready = "yes";
})();
