"""The style of a page: on white and on dark screens, on narrow ones, and on paper."""

from __future__ import annotations

DARK = """color-scheme: dark; --paper: #15191d; --ink: #e4e7ea; --soft: #aab3ba; --line: #3a424a; 
  --strong: #5a646e; --card: #1e2930; --mark: #5fb3dc; --link: #7cc4ea;"""
# A shadow at each edge behind which there is more: two covers scroll with what they cover, the shadows stay.
UNDER = "var(--under, var(--paper))"
SHADOWS = f"""linear-gradient(to right, {UNDER} 40%, transparent) left / 3rem 100% no-repeat local,
  linear-gradient(to left, {UNDER} 40%, transparent) right / 3rem 100% no-repeat local,
  linear-gradient(to right, var(--strong), transparent) left / .8rem 100% no-repeat scroll,
  linear-gradient(to left, var(--strong), transparent) right / .8rem 100% no-repeat scroll, {UNDER}"""
STYLE = f"""
:root {{ color-scheme: light; --paper: #fff; --ink: #222; --soft: #444; --line: #e0e0e0; --strong: #bbb;
  --card: #f1f6f9; --mark: #0b6fa4; --link: #0b5c88; }}
@media screen and (prefers-color-scheme: dark) {{ :root:not(.light) {{ {DARK} }} }}
@media screen {{ :root.dark {{ {DARK} }} }}
* {{ box-sizing: border-box; }}
html {{ scroll-behavior: smooth; }}
body {{ margin: 0 auto; max-width: 68rem; padding: 1.5rem 1rem 4rem; background: var(--paper); color: var(--ink);
  font: 1rem/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; overflow-wrap: break-word; }}
a {{ color: var(--link); }}
h1 {{ font-size: 1.6rem; line-height: 1.25; margin: 0 0 1rem; }}
h2 {{ font-size: 1.2rem; margin: 2.5rem 0 .5rem; padding-top: .75rem; border-top: 1px solid var(--line); }}
h3 {{ font-size: 1rem; margin: 1.5rem 0 .25rem; }}
p, ul {{ max-width: 46rem; }}
.advice {{ margin: 0 0 1rem; padding: .75rem 1rem; border-left: 4px solid var(--mark); background: var(--card);
  font-size: 1.1rem; max-width: none; }}
nav {{ font-size: .92rem; }}
nav ol {{ margin: .25rem 0 0; padding-left: 1.4rem; columns: 18rem; }}
nav a {{ text-decoration: none; }}
nav a:hover {{ text-decoration: underline; }}
.scroll {{ overflow-x: auto; margin: 1rem 0; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; }}
.scroll, .picture, .code pre {{ background: {SHADOWS}; }}
.caption {{ font-weight: 600; margin: 1.25rem 0 0; }}
.caption + .scroll {{ margin-top: .35rem; }}
th, td {{ padding: .3rem 0 .3rem .9rem; text-align: right; vertical-align: top;
  border-bottom: 1px solid var(--line); }}
th:first-child {{ text-align: left; padding-left: 0; position: sticky; left: 0; background: var(--paper); }}
td {{ white-space: nowrap; }}
td small {{ display: block; color: var(--soft); }}
table.words td {{ text-align: left; white-space: normal; }}
thead th {{ border-bottom: 2px solid var(--strong); vertical-align: bottom; }}
figure {{ margin: 1rem 0; position: relative; }}
.picture {{ overflow-x: auto; position: relative; }}
svg {{ display: block; max-width: 100%; height: auto; fill: currentColor; touch-action: pan-y; }}
figcaption {{ color: var(--soft); font-size: .92rem; max-width: 46rem; }}
.read svg {{ cursor: crosshair; }}
.read .value {{ position: absolute; pointer-events: none; display: none; z-index: 2; padding: .25rem .5rem;
  background: var(--paper); border: 1px solid var(--strong); border-radius: .25rem; font-size: .8rem;
  font-variant-numeric: tabular-nums; white-space: pre; line-height: 1.35; }}
pre {{ background: var(--card); padding: .75rem 1rem; overflow-x: auto; font-size: .85rem; line-height: 1.45; }}
.code {{ position: relative; --under: var(--card); }}
.code button {{ position: absolute; top: .4rem; right: .4rem; font: inherit; font-size: .8rem; cursor: pointer;
  color: var(--ink); background: var(--paper); border: 1px solid var(--strong); border-radius: .25rem; }}
details {{ margin: .5rem 0; }}
summary {{ cursor: pointer; font-weight: 600; }}
@media screen and (max-width: 40rem) {{
  body {{ padding: 1rem .75rem 3rem; }}
  h1 {{ font-size: 1.35rem; }}
  th, td {{ padding-left: .7rem; }}
  th:first-child {{ max-width: 6.5rem; }}
  table.fold, table.fold tbody, table.fold tr, table.fold th, table.fold td {{ display: block; }}
  table.fold thead {{ display: none; }}
  table.fold tr {{ padding: .4rem 0; border-bottom: 1px solid var(--strong); }}
  table.fold th:first-child {{ max-width: none; }}
  table.fold th, table.fold td {{ border: 0; padding: .1rem 0; }}
  table.fold td {{ display: flex; flex-wrap: wrap; justify-content: flex-end; gap: 0 .5rem; white-space: normal; }}
  table.fold td::before {{ content: attr(data-head); margin-right: auto; color: var(--soft); }}
  table.fold td small {{ flex-basis: 100%; }}
  table.fold td:empty {{ display: none; }}
  .wide svg {{ max-width: none; width: 38rem; }}
  .wide figcaption::before {{ content: "Scroll the picture sideways. "; font-weight: 600; }}
}}
@media print {{
  @page {{ size: A4; margin: 14mm 12mm; }}
  body {{ max-width: none; padding: 0; font-size: 9.5pt; }}
  nav, .code button, .read .value {{ display: none !important; }}
  h2 {{ margin-top: 1.2rem; break-after: avoid; }}
  h3, .caption {{ break-after: avoid; }}
  .scroll, .picture, pre {{ overflow: visible; }}
  .scroll, .picture {{ background: none; }}
  .code pre {{ background: var(--card); }}
  details > :not(summary) {{ display: block !important; }}
  details::details-content {{ display: block !important; content-visibility: visible !important; }}
  table {{ font-size: 8pt; width: 100%; }}
  table.words {{ width: auto; }}
  table.many {{ font-size: 6.5pt; }}
  th, td {{ padding-left: .45rem; white-space: normal; overflow-wrap: anywhere; }}
  td small {{ white-space: nowrap; font-size: 85%; }}
  th:first-child {{ position: static; }}
  th {{ hyphens: auto; overflow-wrap: normal; }}
  pre {{ white-space: pre-wrap; font-size: 7.5pt; }}
  figure, tr {{ break-inside: avoid; }}
  svg {{ max-height: 235mm; }}
}}
"""


SCRIPT = r"""
(() => {
'use strict';
const element = id => document.getElementById(id);
const inside = (box, p) => p.x >= box[0] && p.x <= box[2] && p.y >= box[1] && p.y <= box[3];
const number = (value, span) => {
  const digits = Math.max(0, Math.min(8, 3 - Math.floor(Math.log10(Math.abs(span) || 1))));
  return Math.abs(value) >= 1e6 || digits > 7 ? value.toPrecision(4) : value.toFixed(digits);
};
function between(low, high, part, log) {
  return log ? low * Math.pow(high / low, part) : low + part * (high - low);
}
function points(path) {
  const found = [];
  for (const [, kind, x, y] of path.getAttribute('d').matchAll(/([ML])\s*(-?[\d.]+)[ ,]+(-?[\d.]+)/g))
    found.push([kind === 'M', +x, +y]);
  return found;
}
function height(line, x) {
  for (let i = 1; i < line.length; i++) {
    const [start, x1, y1] = line[i], [, x0, y0] = line[i - 1];
    if (!start && x0 <= x && x <= x1) return x1 === x0 ? y1 : y0 + (y1 - y0) * (x - x0) / (x1 - x0);
  }
  return null;
}
function wrap(node) {  // what moves in a zoom, within a clip that stays
  const clip = node.getAttribute('clip-path');
  if (!clip) return null;
  const outside = document.createElementNS(node.namespaceURI, 'g');
  outside.setAttribute('clip-path', clip);
  node.removeAttribute('clip-path');
  node.replaceWith(outside);
  outside.append(node);
  node.style.vectorEffect = 'non-scaling-stroke';
  return [node, node.getAttribute('transform') || ''];
}
document.querySelectorAll('figure[data-read]').forEach(figure => {
  const svg = figure.querySelector('svg'), holder = figure.querySelector('.picture');
  const axes = JSON.parse(figure.dataset.read);
  const shown = document.createElement('div');
  shown.className = 'value';
  holder.append(shown);
  const cursors = axes.map(axis => {
    const line = document.createElementNS(svg.namespaceURI, 'path');
    line.setAttribute('style', 'stroke: currentColor; stroke-width: .6; fill: none; opacity: .6; display: none');
    svg.append(line);
    axis.paths = axis.lines.map(([id, label]) => [label, points(element(id).querySelector('path'))]);
    axis.now = axis.x.slice();
    return line;
  });
  const place = event => {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    return {x: point.x, y: point.y};
  };
  const back = (axis, x) => {  // from what is seen to where it was drawn
    const [a, b] = axis.x, [c, d] = axis.now, [left, , right] = axis.box;
    return left + (c + (x - left) / (right - left) * (d - c) - a) / (b - a) * (right - left);
  };
  const hide = () => { shown.style.display = 'none'; cursors.forEach(line => line.style.display = 'none'); };
  let start = null;
  svg.addEventListener('pointermove', event => {
    const p = place(event), axis = axes.find(one => inside(one.box, p));
    if (!axis) return hide();
    const [left, top, right, bottom] = axis.box, part = (p.x - left) / (right - left);
    const old = axis.log[0] ? p.x : back(axis, p.x);
    const x = between(...(axis.log[0] ? axis.x : axis.now), part, axis.log[0]);
    const label = axis.label || (axes.find(one => one.label && one.box[0] === left) || axis).label || 'x';
    const rows = [`${label}: ${number(x, axis.now[1] - axis.now[0])}`];
    for (const [name, line] of axis.paths) {
      const y = height(line, old);
      if (y === null) continue;
      const value = between(axis.y[0], axis.y[1], (bottom - y) / (bottom - top), axis.log[1]);
      rows.push(`${name}: ${number(value, axis.log[1] ? value : axis.y[1] - axis.y[0])}`);
    }
    shown.textContent = rows.join('\n');
    shown.style.display = 'block';
    const frame = holder.getBoundingClientRect(), wide = shown.offsetWidth;
    const at = event.clientX - frame.left + holder.scrollLeft;
    const left_of_it = at + 14 + wide > holder.scrollLeft + frame.width;
    shown.style.left = `${left_of_it ? Math.max(0, at - 14 - wide) : at + 14}px`;
    shown.style.top = `${event.clientY - frame.top + 12}px`;
    axes.forEach((one, i) => {
      const same = one.box[0] === left && one.box[2] === right;
      cursors[i].style.display = same ? 'inline' : 'none';
      const from = start && same ? `M${start.x} ${one.box[1]}V${one.box[3]}` : '';
      cursors[i].setAttribute('d', `${from}M${p.x} ${one.box[1]}V${one.box[3]}`);
    });
  });
  svg.addEventListener('pointerleave', () => { start = null; hide(); });
  if (axes.some(axis => axis.log[0])) return;
  const key = axis => axis.x.join();
  function zoom(kind, low, high) {
    for (const axis of axes.filter(one => key(one) === kind)) {
      const group = element(axis.id), [left, , right] = axis.box, [a, b] = axis.x;
      axis.moving = axis.moving || [...group.querySelectorAll('[clip-path]')]
        .filter(node => !node.closest('[id*="matplotlib.axis"]')).map(wrap).filter(Boolean);
      const scale = (b - a) / (high - low), shift = left - scale * (left + (low - a) / (b - a) * (right - left));
      for (const [node, before] of axis.moving)
        node.setAttribute('transform', `translate(${shift} 0) scale(${scale} 1) ${before}`);
      axis.now = [low, high];
      for (const tick of group.querySelectorAll('[id*="xtick"] text')) {
        const box = tick.getBBox(), part = (box.x + box.width / 2 - left) / (right - left);
        tick.dataset.was = tick.dataset.was || tick.textContent;
        const whole = low === a && high === b;
        tick.textContent = whole ? tick.dataset.was : number(low + part * (high - low), 100 * (high - low));
      }
    }
  }
  svg.addEventListener('pointerdown', event => {
    const p = place(event), axis = axes.find(one => inside(one.box, p));
    if (axis && event.pointerType === 'mouse') { start = {x: p.x, axis}; event.preventDefault(); }
  });
  svg.addEventListener('pointerup', event => {
    if (!start) return;
    const {x, axis} = start, [left, , right] = axis.box, end = Math.min(Math.max(place(event).x, left), right);
    start = null;
    if (Math.abs(end - x) < 6) return;
    const [low, high] = [x, end].sort((p, q) => p - q)
      .map(one => between(axis.now[0], axis.now[1], (one - left) / (right - left), false));
    zoom(key(axis), low, high);
  });
  svg.addEventListener('dblclick', event => {
    const p = place(event), axis = axes.find(one => inside(one.box, p));
    if (axis) zoom(key(axis), axis.x[0], axis.x[1]);
  });
});
document.querySelectorAll('.code').forEach(block => {
  if (!navigator.clipboard) return;
  const button = document.createElement('button');
  button.textContent = 'copy';
  button.addEventListener('click', () => navigator.clipboard.writeText(block.querySelector('pre').textContent)
    .then(() => { button.textContent = 'copied'; }));
  block.append(button);
});
addEventListener('beforeprint', () => document.querySelectorAll('details').forEach(one => one.open = true));
})();
"""
