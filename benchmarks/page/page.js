"use strict";
const figures = JSON.parse(document.getElementById("figures").textContent);
const narrow = matchMedia("(max-width: 700px)"), dark = matchMedia("(prefers-color-scheme: dark)");
const plot = document.getElementById("plot"), caption = document.getElementById("caption");
let shown = Object.keys(figures)[0], hidden = new Set();

function layout(figure) {
  const style = getComputedStyle(document.documentElement), ink = style.getPropertyValue("--ink");
  const line = style.getPropertyValue("--line"), result = structuredClone(narrow.matches ? figure.narrow : figure.wide);
  Object.assign(result, {paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)"});
  result.font = {...result.font, color: ink};
  result.hoverlabel = {...result.hoverlabel, bgcolor: style.getPropertyValue("--paper"), font: {color: ink}};
  for (const [key, axis] of Object.entries(result)) {
    if (/^[xy]axis/.test(key)) Object.assign(axis, {gridcolor: line, linecolor: line, zerolinecolor: line});
  }
  return result;
}

function draw() {
  const figure = figures[shown];
  for (const trace of figure.data) trace.visible = hidden.has(trace.legendgroup) ? "legendonly" : true;
  Plotly.react(plot, figure.data, layout(figure), {responsive: true, displaylogo: false, displayModeBar: narrow.matches ? false : "hover"});
  caption.textContent = figure.caption;
  for (const button of document.querySelectorAll("nav button")) {
    button.setAttribute("aria-selected", button.dataset.figure === shown);
  }
}

// what is switched off stays off in the other tabs
function remember() {
  hidden = new Set(plot.data.filter(trace => trace.visible === "legendonly").map(trace => trace.legendgroup));
}

for (const button of document.querySelectorAll("nav button")) {
  button.addEventListener("click", () => { remember(); shown = button.dataset.figure; draw(); });
}
for (const query of [narrow, dark]) query.addEventListener("change", () => { remember(); draw(); });
draw();

function sort(head) {
  const table = head.closest("table"), column = head.cellIndex, body = table.tBodies[0];
  const descending = head.getAttribute("aria-sort") !== "descending";
  const key = row => row.cells[column].dataset.value ?? row.cells[column].textContent;
  const compare = (a, b) => (isNaN(a) || isNaN(b) || a === "" || b === "" ? String(a).localeCompare(String(b)) : a - b);
  const rows = [...body.rows].sort((a, b) => (descending ? -1 : 1) * compare(key(a), key(b)));
  for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", descending ? "descending" : "ascending");
  body.append(...rows);
}

for (const head of document.querySelectorAll("th[data-sortable]")) {
  head.tabIndex = 0;
  head.addEventListener("click", () => sort(head));
  head.addEventListener("keydown", event => { if (event.key === "Enter") sort(head); });
}
