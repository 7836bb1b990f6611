"use strict"
// The page says what is set; all numbers come from the server. One question is under way at a time, and of the views
// that are asked for meanwhile only the last one, so that pictures follow a slider at whatever pace this machine has.
const get = id => document.getElementById(id)
const make = (tag, options = {}, ...inside) => {
  const made = Object.assign(document.createElement(tag), options)
  made.append(...inside)
  return made
}
const STEPS = 1000
let wire, spec, values = {}, number = 0, asked = null, nextView = null, queue = [], best = null, studying = false
const knobs = new Map()
const number_text = value => {
  if (value === null || value === undefined) return "\u2013"
  const size = Math.abs(value)
  return size !== 0 && (size < 1e-3 || size >= 1e5) ? value.toExponential(2) : String(+value.toPrecision(4))
}

function ask(what, more = {}, began = null) {
  const question = {do: what, ...more, width: picture_width, dark: document.documentElement.classList.contains("dark")}
  if (what === "view") nextView = {question, began: began ?? performance.now()}
  else queue.push({question, began: null})
  send()
}
function send() {
  if (asked !== null || !wire) return
  asked = queue.shift() ?? nextView
  if (!asked) { asked = null; return }
  if (asked === nextView) nextView = null
  asked.question.number = ++number
  if (asked.question.do === "view") asked.question.values = {...values}
  wire.asked = JSON.stringify(asked.question)
}
const bytes_of = base64 => Uint8Array.fromBase64?.(base64) ?? Uint8Array.from(atob(base64), letter => letter.charCodeAt(0))
const models = new Map()
function model(name) {
  if (!models.has(name)) models.set(name, Bokeh.documents[0].get_model_by_name(name))
  return models.get(name)
}
// Numbers and axes of all pictures at once, so that one frame of the screen shows them; the server knows them.
function draw({numbers, columns, axes}) {
  paint_without_styles()
  const {buffer} = bytes_of(numbers), silently = {sync: false, check_eq: false}
  const part = at => Array.isArray(at[0]) ? at.map(part) : new Float32Array(buffer, 4 * at[0], at[1] - at[0])
  for (const [name, own] of Object.entries(columns))
    model(name).setv({data: Object.fromEntries(Object.entries(own).map(([column, at]) => [column, part(at)]))}, silently)
  for (const [name, own] of Object.entries(axes))
    for (const [axis, [start, end]] of Object.entries(own)) model(name)[`${axis}_range`].setv({start, end}, silently)
}
// Whenever Bokeh paints, it writes where each axis and glyph lies into a style sheet of its own, and asks the styles of
// the page for each colour and width: two thirds of the time of a picture. Nothing here needs these places and styles.
function paint_without_styles() {
  for (const {model, renderer_views} of Bokeh.index.roots) {
    for (const view of renderer_views?.values() ?? []) {
      if (model.name !== "map") view.update_position = () => {}
      let kind = Object.values(view.visuals ?? {}).find(visual => visual?._get_css_value)
      while (kind && !Object.hasOwn(kind, "_get_css_value")) kind = Object.getPrototypeOf(kind)
      if (kind) kind._get_css_value = () => ""
    }
  }
}
function heard(told) {
  if (told.drawn) draw(told.drawn)
  const answered = told.answers === number ? asked : null
  if (answered) {
    asked = null
    complain(told.error ?? "")
    if (answered.began !== null) after_painting(() => performance.measure("move to picture", {start: answered.began}))
  } else if (told.error) complain(told.error)
  if (told.spec) { spec = told.spec; values = {...told.values}; get("title").textContent = spec.title; build(); draw_map() }
  else if (told.values && !nextView) { values = {...told.values}; place_knobs() }
  if (told.figures) show_figures(told.figures)
  if (told.held) add_held(told.held)
  if (told.file) receive(told.file)
  if (told.study) show_study(told.study)
  if (told.map || told.error) document.body.classList.remove("busy")
  send()
}
const after_painting = call => requestAnimationFrame(() => { const {port1, port2} = new MessageChannel(); port1.onmessage = call; port2.postMessage(0) })
const AXIS = 54  // pixels of a picture's width
let picture_width = 800
function measure() { picture_width = Math.round(((document.querySelector(".picture:not([hidden])")?.clientWidth || 800) - AXIS) * Math.min(devicePixelRatio, 2)) }
const put = (element, name, value) => { if (element[name] !== value) element[name] = value }  // unlike it, no change costs nothing
function complain(text) { put(get("error"), "textContent", text); put(get("error"), "hidden", !text) }

// Knobs
const to_place = (knob, value) => STEPS * (knob.log ? Math.log(value / knob.low) / Math.log(knob.high / knob.low) : (value - knob.low) / (knob.high - knob.low))
function from_place(knob, place) {
  const part = place / STEPS
  const value = knob.log ? knob.low * (knob.high / knob.low) ** part : knob.low + part * (knob.high - knob.low)
  return knob.integer ? Math.round(value) : value
}
const OPEN = ["Q", "R", "filter"]
function build() {
  const filter = get("filter")
  filter.replaceChildren(...spec.filters.map(name => make("option", {value: name, textContent: name, selected: name === spec.filter})))
  build_presets()
  get("steps")?.replaceChildren(...spec.steps.map((label, step) => make("button", {type: "button", textContent: label, onclick: () => ask("step", {step})})))
  const were = new Map([...get("groups").children].map(one => [one.dataset.group, one.open]))
  knobs.clear()
  const groups = new Map()
  for (const knob of spec.knobs) {
    if (!groups.has(knob.group)) groups.set(knob.group, make("details", {open: were.get(knob.group) ?? OPEN.includes(knob.group)}, make("summary", {textContent: title_of(knob.group)})))
    groups.get(knob.group).append(build_knob(knob))
    groups.get(knob.group).dataset.group = knob.group
  }
  get("groups").replaceChildren(...groups.values())
  for (const [id, at] of [["x", 0], ["y", 1]]) {
    const was = get(id).value || spec.axes[at]
    get(id).replaceChildren(...spec.knobs.map((knob, place) => make("option", {value: knob.name, textContent: knob.label, selected: was ? knob.name === was : place === at})))
  }
  build_shown()
  place_knobs()
}
const title_of = group => ({Q: "Q, process noise", R: "R, measurement noise", filter: "The filter's own", prior: "Prior", disturbances: "Disturbances of the plant", correlations: "Correlations"})[group] ?? group
function build_knob(knob) {
  const named = knob.unit ? `${knob.label} [${knob.unit}]` : knob.label
  const range = make("input", {type: "range", min: 0, max: STEPS, step: "any", id: `knob-${knob.name}`})
  const text = make("input", {type: "text", inputMode: "decimal"})
  text.setAttribute("aria-label", `${named}, as a number`)
  range.oninput = event => { values[knob.name] = from_place(knob, +range.value); place_knobs(range); ask("view", {}, event.timeStamp) }
  range.onkeydown = event => {
    const by = {ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1, PageUp: 5, PageDown: -5}[event.key]
    if (!by) return
    event.preventDefault()
    const size = knob.integer ? by : null
    if (size) values[knob.name] = Math.min(knob.high, Math.max(knob.low, values[knob.name] + size))
    else values[knob.name] = from_place(knob, Math.min(STEPS, Math.max(0, +range.value + by * 10)))
    place_knobs()
    ask("view", {}, event.timeStamp)
  }
  text.onchange = () => {
    const value = Number(text.value.replace(",", ".").replace("\u2212", "-"))
    if (text.value.trim() === "" || !Number.isFinite(value)) {
      complain(`${knob.label} must be a number from ${number_text(knob.low)} to ${number_text(knob.high)}, but got ${text.value || "nothing"}`)
      text.ariaInvalid = "true"
      return
    }
    values[knob.name] = Math.min(knob.high, Math.max(knob.low, knob.integer ? Math.round(value) : value))
    place_knobs()
    text.value = number_text(values[knob.name])  // what is used: the end of the range for what lies beyond
    ask("view")
  }
  const marks = make("div", {className: "marks"})
  const together = []
  for (const [name, value] of Object.entries(knob.marks)) {
    const at = Math.min(100, Math.max(0, to_place(knob, value) / STEPS * 100))
    const near = together.find(one => Math.abs(one.at - at) < 9)
    if (near) near.names.push(name)
    else together.push({at, value, names: [name]})
  }
  for (const {at, value, names} of together) {
    const letters = names.map(letter_of).join("")
    const button = make("button", {type: "button", textContent: letters, title: names.join(", ")})
    button.setAttribute("aria-label", `${letters}: ${named} of ${names.join(", ")}`)
    button.style.left = `${at}%`
    button.onclick = () => { values[knob.name] = value; place_knobs(); ask("view") }
    marks.append(button)
  }
  knobs.set(knob.name, {knob, range, text})
  return make("div", {className: "knob"}, make("label", {htmlFor: range.id, textContent: named}), text, make("div", {className: "slide"}, range, marks))
}
const letter_of = name => ({"rule of thumb": "R", "scaled default": "S", tuned: "T", oracle: "O", given: "G"})[name] ?? name[0].toUpperCase()
function place_knobs(dragged = null) {
  for (const [name, {knob, range, text}] of knobs) {
    const said = number_text(values[name])
    if (range !== dragged) put(range, "value", String(to_place(knob, values[name])))
    put(range, "ariaValueText", said)
    if (document.activeElement !== text || dragged) put(text, "value", said)
    put(text, "ariaInvalid", null)
  }
}
function build_presets() {
  const names = [...new Set(spec.knobs.flatMap(knob => Object.keys(knob.marks)))]
  const set = chosen => () => { values = {...values, ...chosen}; place_knobs(); ask("view") }
  const buttons = [make("button", {type: "button", textContent: "Start", onclick: set(spec.start)})]
  for (const name of names) {
    const chosen = Object.fromEntries(spec.knobs.filter(knob => name in knob.marks).map(knob => [knob.name, knob.marks[name]]))
    buttons.push(make("button", {type: "button", textContent: `${letter_of(name)} ${name}`, onclick: set(chosen)}))
  }
  get("presets").replaceChildren(make("span", {className: "key", textContent: "Set all to"}), ...buttons)
}

// What is seen
function build_shown() {
  const boxes = spec.states.map((name, place) => {
    const box = make("input", {type: "checkbox", checked: spec.shown.includes(place), onchange: tell_shown})
    box.dataset.place = place
    return make("label", {}, box, name)
  })
  const errors = make("input", {type: "checkbox", id: "errors", onchange: tell_shown, disabled: !spec.truth})
  const run = make("select", {id: "seed", onchange: tell_shown}, ...Array.from({length: spec.seeds}, (_, place) => make("option", {value: place, textContent: place + 1})))
  get("shown").replaceChildren(...boxes, ...(spec.truth ? [make("label", {}, errors, "errors of all runs")] : []), make("label", {htmlFor: "seed", textContent: "Run"}), run)
  hide_pictures()
}
const states_shown = () => [...get("shown").querySelectorAll("input[data-place]:checked")].map(box => +box.dataset.place)
function hide_pictures() {
  const shown = states_shown()
  for (const one of document.querySelectorAll('.picture[data-name^="state"]')) one.hidden = !shown.includes(+one.dataset.name.slice(5))
  measure()
}
function tell_shown() {
  hide_pictures()
  ask("plotted", {states: states_shown(), run: +get("seed").value, errors: get("errors")?.checked ?? false})
}
function show_figures(figures) {
  const names = Object.keys(figures), rows = get("figures").children
  if (names.join() !== [...rows].map(row => row.firstChild.title).join())
    get("figures").replaceChildren(...names.map(name => make("div", {}, make("dt", {textContent: name.replace(/:.*/, ""), title: name}), make("dd"))))
  for (const [place, {value, unit: measured, better, target, start}] of Object.values(figures).entries()) {
    const unit = measured === "-" ? "" : measured, number = rows[place].lastChild
    const [arrow, judgement] = against(value, start, better, target)
    put(number, "textContent", `${number_text(value)} ${unit} ${arrow}`)
    put(number, "className", judgement)
    put(number, "title", judgement ? `${judgement} than at the start: ${number_text(start)} ${unit}` : "")
  }
}
function against(value, start, better, target) {
  if (value === null || start === null || Math.abs(value - start) <= 1e-3 * Math.abs(start)) return ["", ""]
  const gain = better === "lower" ? start - value : better === "higher" ? value - start : distance(start, target) - distance(value, target)
  return [value > start ? "\u2191" : "\u2193", Number.isFinite(gain) ? (gain > 0 ? "better" : "worse") : ""]
}
const distance = (value, target) => value > 0 && target > 0 ? Math.abs(Math.log(value / target)) : Math.abs(value - target)
function add_held({slot, colour, filter, figures}) {
  const name = Object.keys(figures).find(one => one.startsWith("score")) ?? Object.keys(figures)[0], value = figures[name]
  const line = make("i")
  line.style.color = colour
  const item = make("li", {}, line, make("span", {textContent: `${filter}: ${name.replace(/:.*/, "")} ${number_text(value)}`}))
  item.append(make("button", {type: "button", textContent: "Drop", ariaLabel: `Drop held configuration ${slot + 1}`, onclick: () => { item.remove(); ask("drop", {slot}) }}))
  get("held").append(item)
}
function receive({name, type, text, base64}) {
  const bytes = base64 ? bytes_of(base64) : text
  const link = make("a", {href: URL.createObjectURL(new Blob([bytes], {type})), download: name})
  link.click()
  setTimeout(() => URL.revokeObjectURL(link.href), 1e4)
  get("exported").hidden = !text || type === "image/svg+xml"
  get("text").value = text ?? ""
}

// Map and study
function draw_map() {
  document.body.classList.add("busy")
  ask("map", {x: get("x").value, y: get("y").value, what: get("what").value})
}
function show_study({done, trial, trials, best: found}) {
  studying = !done
  get("run").textContent = studying ? "Stop" : "Run"
  if (found) {
    best = found
    get("progress").value = trial / trials
    get("best").textContent = `Trial ${trial} of ${trials}: least score ${number_text(found.score)}`
  }
  get("take").disabled = !best
}
function listen() {
  get("filter").onchange = () => ask("filter", {filter: get("filter").value})
  get("hold").onclick = () => ask("hold")
  get("export").onclick = () => ask("export", {kind: get("kind").value})
  get("map").onclick = get("x").onchange = get("y").onchange = get("what").onchange = draw_map
  get("run").onclick = () => {
    if (studying) { ask("stop"); return }
    best = null
    get("progress").value = 0
    show_study({done: false})
    ask("study", {trials: +get("trials").value})
  }
  get("take").onclick = () => { values = {...values, ...best.values}; place_knobs(); ask("view") }
  addEventListener("resize", measure)
  measure()
  get("knobs").onsubmit = event => event.preventDefault()
  const dark = matchMedia("(prefers-color-scheme: dark)")
  const ground = is => { document.documentElement.classList.toggle("dark", is); get("ground").textContent = is ? "Light" : "Dark" }
  ground(dark.matches)
  dark.onchange = () => { ground(dark.matches); ask("ground") }
  get("ground").onclick = () => { ground(!document.documentElement.classList.contains("dark")); ask("ground") }
}
function begin() {
  const ours = window.Bokeh?.documents?.[0]
  wire = ours?.get_model_by_name("map")?.tags?.[0]
  if (!wire) { setTimeout(begin, 50); return }
  wire.properties.told.change.connect(() => heard(JSON.parse(wire.told)))
  ours.on_event("connection_lost", () => {
    document.body.classList.add("gone")
    complain("The server has ended: what is seen stays, and nothing more can be set. Start it again with thruster explore.")
  })
  ask("hello")
}
listen()
begin()
