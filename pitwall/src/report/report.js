const parsed = (id) => JSON.parse(document.getElementById(id)?.textContent ?? "null");
const shownView = parsed("analysis-view");
if (shownView) {
  const laps = parsed("analysis-data");
  window.analysis = new Analysis(document.getElementById("analysis"), { load: (id) => laps[id] });
  window.analysis.update(shownView);
}
for (const figure of document.querySelectorAll("figure")) {
  const caption = figure.querySelector("figcaption"), svg = figure.querySelector("svg"), data = figure.querySelector("script");
  const title = caption.textContent.split(":")[0];
  const link = (name, act) => {
    const made = document.createElement("a");
    made.textContent = name;
    made.href = "#";
    made.title = `save ${title} as ${name}`;
    made.addEventListener("click", (event) => { event.preventDefault(); act(); });
    caption.append(made);
  };
  link("SVG", () => {
    // With its colours, so that it looks the same elsewhere.
    const copy = svg.cloneNode(true);
    const parts = svg.querySelectorAll("*"), copies = copy.querySelectorAll("*");
    parts.forEach((part, i) => {
      const style = getComputedStyle(part);
      for (const name of ["fill", "stroke", "stroke-width", "stroke-dasharray", "opacity", "font", "text-anchor"]) copies[i].style[name] = style[name];
    });
    save(`${title}.svg`, new XMLSerializer().serializeToString(copy), "image/svg+xml");
  });
  if (data) link("CSV", () => save(`${title}.csv`, data.textContent.trim(), "text/csv"));
}
