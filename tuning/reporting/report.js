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
