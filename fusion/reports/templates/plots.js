// Draws the figures of the page, links them, and lets the legend show or hide a series.
(async () => {
  const page = JSON.parse(document.getElementById("plots").textContent);
  await Bokeh.embed.embed_items(page.docs, page.render);
  const doc = Bokeh.documents[0];
  const models = [...doc._all_models.values()];
  const named = (start) => models.filter((model) => model.name != null && model.name.startsWith(start));
  const figures = models.filter((model) => model.type === "Figure");
  const [time] = named("time axis");
  const runs = named("run ").map((source) => ({ label: source.name.slice(4), whole: { ...source.data }, source }));
  const readout = document.getElementById("readout");

  const nearest = (values, x) => {
    let low = 0, high = values.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (values[middle] < x) low = middle; else high = middle;
    }
    return x - values[low] < values[high] - x ? low : high;
  };
  const digits = (value, unit) => (Number.isFinite(value) ? value.toFixed(2) + unit : "–");

  // A cursor in time: a line in the figures over time, a mark on each path, and the values as text.
  const [marks] = named("cursor marks");
  const show = (t, cursor) => {
    cursor.setv({ location: t, visible: true });
    if (readout == null) return;
    const rows = runs.map(({ whole }) => nearest(whole.t, t));
    if (marks != null) {
      marks.data = {
        ...marks.data,
        x: runs.map(({ whole }, i) => whole.x[rows[i]]),
        y: runs.map(({ whole }, i) => whole.y[rows[i]]),
      };
    }
    readout.textContent = `${t.toFixed(1)} s` + runs.map(({ label, whole }, i) =>
      `  |  ${label}: error ${digits(whole.error[rows[i]], " m")}, slip ${digits(whole.slip[rows[i]], "")}`).join("");
  };
  const cursor_of = (figure) => figure.center.find((model) => model.name === "cursor line");
  const [shared] = figures.map(cursor_of).filter((cursor) => cursor != null);
  for (const figure of figures) {
    const cursor = cursor_of(figure);
    const move = (event) => {
      if (cursor != null) return show(Math.min(Math.max(event.x, 0), figure.x_range.bounds[1]), cursor);
      let best = Infinity, when = null;
      for (const { whole } of runs) {
        for (let i = 0; i < whole.x.length; i++) {
          const away = (whole.x[i] - event.x) ** 2 + (whole.y[i] - event.y) ** 2;
          if (away < best) [best, when] = [away, whole.t[i]];
        }
      }
      if (when != null) show(when, shared);
    };
    figure.on_event("mousemove", move);
    figure.on_event("tap", move);
  }

  // The map keeps bright what the figures over time show.
  const cut = () => {
    for (const { whole, source } of runs) {
      const first = whole.t.findIndex((t) => t >= time.start);
      const past = whole.t.findLastIndex((t) => t <= time.end) + 1;
      const rows = [Math.max(first, 0), first < 0 ? 0 : past];
      source.data = Object.fromEntries(Object.entries(whole).map(([key, all]) => [key, all.slice(...rows)]));
    }
  };
  let waiting = null;
  if (runs.length > 0) time.on_change([time.properties.start, time.properties.end], () => {
    clearTimeout(waiting);
    waiting = setTimeout(cut, 60);
  });

  for (const box of document.querySelectorAll("input[data-series]")) {
    box.addEventListener("change", () => {
      for (const model of named(box.dataset.series)) {
        if (model.name === box.dataset.series) model.visible = box.checked;
      }
    });
  }

  // A drag on a touch screen scrolls the page; colours follow the page's, on paper too.
  if (matchMedia("(pointer: coarse)").matches) {
    for (const figure of figures) figure.toolbar.gestures.pan.active = null;
  }
  const root = document.documentElement;
  const paint = () => figures.forEach((figure) => Bokeh.index.find_one(figure)?.repaint());
  const paper = (is) => () => {
    root.toggleAttribute("data-paper", is);
    figures.forEach((figure) => {
      const view = Bokeh.index.find_one(figure);
      view?.request_repaint();
      view?.paint();
    });
  };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", paint);
  addEventListener("beforeprint", paper(true));
  addEventListener("afterprint", paper(false));
  root.dataset.drawn = "yes";
})();
