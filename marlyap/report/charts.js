"use strict";
(() => {
  const [documents, items] = JSON.parse(document.getElementById("charts").textContent);
  const every = (selector) => [...document.querySelectorAll(selector)];
  const darkness = matchMedia("(prefers-color-scheme: dark)"), coarse = matchMedia("(pointer: coarse)");
  const buttons = every(".switches button"), off = { team: new Set(), member: new Set() };
  const figures = new Map(); // element's id -> Bokeh's figure

  // ---- colours: the frame follows the style by itself, the curves are told ----

  function paint() {
    const style = getComputedStyle(document.documentElement);
    const read = (name) => style.getPropertyValue("--" + name).trim();
    for (const figure of figures.values()) {
      for (const { glyph, hover_glyph } of figure.renderers) {
        const tint = glyph.tags[2];
        if (tint === -2) continue; // the ground of level sets
        const colour = read(tint < 0 ? "ink" : "c" + tint);
        for (const part of [glyph, hover_glyph]) {
          if (!part) continue;
          for (const name of ["line_color", "fill_color"]) {
            const old = name in part.properties && part[name];
            if (old && old.value !== null) part[name] = { value: colour };
          }
        }
      }
      for (const part of [...figure.left, ...figure.below]) part.change.emit();
      figure.change.emit();
    }
  }

  // ---- switches: a curve is shown while its run and its configuration are on ----

  function show() {
    for (const figure of figures.values()) {
      for (const renderer of figure.renderers) {
        const [team, member] = renderer.glyph.tags;
        if (team >= 0) renderer.visible = !off.team.has(team) && !off.member.has(member);
      }
    }
  }

  for (const button of buttons) {
    button.addEventListener("click", () => {
      const kind = "team" in button.dataset ? "team" : "member", number = Number(button.dataset[kind]);
      const now = off[kind].has(number);
      off[kind][now ? "delete" : "add"](number);
      button.setAttribute("aria-pressed", String(now));
      show();
    });
  }

  // ---- data to take away ----

  const quoted = (value) => /[",\n]/.test(String(value)) ? `"${String(value).replaceAll('"', '""')}"` : String(value ?? "");

  function rows(figure) {
    const lines = figure.renderers.filter(({ glyph }) => ["Line", "Image"].includes(glyph.type));
    if (lines.some(({ glyph }) => glyph.type === "Image")) return ground(lines[0]);
    const names = ["x", "y", "low", "high"], [across, up] = [figure.below[0].axis_label, figure.left[0].axis_label];
    const told = [["curve", across, up, "low", "high"]];
    for (const { name, data_source: { data } } of lines) {
      const columns = names.map((key) => column(data, key));
      for (let k = 0; k < columns[0].length; k++) told.push([name, ...columns.map((values) => values?.[k])]);
    }
    return told;
  }

  const column = (data, key) => (data instanceof Map ? data.get(key) : data[key]);

  function ground({ data_source: { data }, glyph }) {
    const image = column(data, "image")[0], [height, width] = image.shape, told = [["x", "y", "V"]];
    const [x, y, dw, dh] = ["x", "y", "dw", "dh"].map((name) => glyph[name].value ?? column(data, name)[0]);
    for (let i = 0; i < height; i++) {
      for (let k = 0; k < width; k++) told.push([x + dw * k / (width - 1), y + dh * i / (height - 1), image[i * width + k] ?? image.get(i, k)]);
    }
    return told;
  }

  const asText = (figure) => rows(figure).map((row) => row.map(quoted).join(",")).join("\n") + "\n";

  for (const button of every("[data-chart]")) {
    button.addEventListener("click", () => {
      const figure = figures.get(button.dataset.chart);
      if (button.classList.contains("reset")) return figure.reset.emit();
      const link = document.createElement("a");
      link.href = URL.createObjectURL(new Blob([asText(figure)], { type: "text/csv" }));
      link.download = `${button.dataset.file}.csv`;
      link.click();
      URL.revokeObjectURL(link.href);
    });
  }

  // ---- begin ----

  Bokeh.embed.embed_items(documents, items).then(() => {
    const elements = items[0].roots, roots = Bokeh.documents[0].roots();
    for (const root of roots) {
      const element = document.getElementById(elements[root.id]);
      figures.set(element.id, root);
      element.addEventListener("dblclick", () => root.reset.emit());
      if (coarse.matches) root.toolbar.active_drag = null; // a finger scrolls the page
    }
    paint();
    darkness.addEventListener("change", paint);
    globalThis.marlyapCharts = { figures, asText };
    document.documentElement.dataset.charts = "ready";
  });
})();
