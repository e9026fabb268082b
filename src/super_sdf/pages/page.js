"use strict";
// The list of files, made from the facts in the page. Texts of files are only ever set as text.

const facts = JSON.parse(document.getElementById("facts").textContent);
const COLOURINGS = ["Plain", "Normals", "Residuals"];
const ORDERS = {
  "failures first": null,
  "slowest first": (a, b) => b.seconds - a.seconds,
  "largest residual first": (a, b) => b.residual - a.residual,
  "by name": (a, b) => (a.name < b.name ? -1 : 1),
};
const SEARCHED_FROM = 6; // files, from which on they can be searched and sorted
const arrived = {}; // by id: what to call when the meshes from beside the page are there
let shown = null; // the viewer that is open: one at a time, since each holds the meshes

/** Called by the files beside the page. */
function superSdfMeshes(id, meshes) { arrived[id]?.(meshes); }

/** Return an element; properties that begin with "aria" are attributes, strings become text. */
function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.includes("-") || name === "role") element.setAttribute(name, value);
    else element[name] = value;
  }
  element.append(...children.filter((child) => child !== null));
  return element;
}

/** Return rows of label and text. */
function rows(pairs, className = "rows") {
  const lines = pairs.map(([label, text]) => make("div", {}, make("dt", {}, label), make("dd", {}, text)));
  return make("dl", { className }, ...lines);
}

/** Return a block with a heading; null if there is nothing in it. */
function block(title, pairs) {
  return pairs.length ? make("section", {}, make("h2", {}, title), rows(pairs)) : null;
}

function sentences(className, label, texts) {
  return texts.map((text) => make("p", { className }, make("b", {}, label), " ", text));
}

function head() {
  document.title = facts.title;
  document.getElementById("head").append(
    make("h1", {}, facts.title),
    facts.lead ? make("p", { className: "lead" }, facts.lead) : "",
    rows(facts.summary, "tiles"),
    ...sentences("note", "Note:", facts.notes),
    make("p", { className: "made" }, `super-sdf ${facts.version}, ${facts.made}`),
  );
}

function badge(text, kind) { return make("span", { className: `badge ${kind}` }, text); }

function badges(file) {
  const found = [];
  if (file.status === "failed") found.push(badge("failed", "bad"));
  if (file.status === "waiting") found.push(badge("not begun", "dull"));
  if (file.faults.length) found.push(badge("faults", "bad"));
  if (file.warnings.length) found.push(badge("warning", "warn"));
  return found;
}

/** Return the line of a file, which opens and closes the rest. */
function summaryOf(file) {
  const figures = [];
  if (file.residual !== null) figures.push(`mean residual ${file.residual.toFixed(4)} voxels`);
  if (file.seconds !== null) figures.push(`${file.seconds.toFixed(1)} s`);
  return make("summary", {},
    make("span", { className: "what" },
      make("span", { className: "name" }, file.name, " ", ...badges(file)),
      make("span", { className: file.reason ? "reason" : "line" }, file.reason || file.line)),
    make("span", { className: "figures" }, figures.join(" · ")));
}

/** Return what is known of a file, and fill in the viewer when its meshes are there. */
function detailsOf(file) {
  const viewer = make("div", { className: "viewer" });
  if (file.meshes) showMeshes(file, viewer);
  return make("div", { className: "details" },
    ...sentences("bad", "Fault:", file.faults),
    ...sentences("warn", "Warning:", file.warnings),
    ...sentences("note", "Note:", file.notes),
    ...sentences("note", "Here:", file.remarks),
    file.meshes ? viewer : null,
    make("div", { className: "blocks" },
      block("Certificate", file.certificate), block("Time", file.stages), block("Conversion", file.facts)));
}

/** Return the packed meshes of a file, from the page or from beside it. */
function packedMeshes(file) {
  if (file.meshes === "page") {
    return Promise.resolve(JSON.parse(document.getElementById(`meshes-${file.id}`).textContent));
  }
  return new Promise((resolve, reject) => {
    arrived[file.id] = resolve;
    const script = make("script", { src: file.meshes });
    script.onerror = () => reject(new Error(`${file.meshes} is not beside this page`));
    script.onload = () => script.remove();
    document.head.append(script);
  });
}

async function showMeshes(file, place) {
  place.replaceChildren(make("p", { className: "note", role: "status" }, "The meshes are being unpacked."));
  try {
    const meshes = await Promise.all((await packedMeshes(file)).map(unpack));
    if (!place.isConnected) return;
    closeViewer();
    openViewer(meshes, place);
  } catch (error) {
    place.replaceChildren(make("p", { className: "bad" }, `The meshes cannot be shown: ${error.message}`));
  }
}

function openViewer(meshes, place) {
  const canvases = meshes.map((mesh) => make("canvas", { role: "img", "aria-label": mesh.caption }));
  const turned = make("div", { className: "views", tabIndex: 0, role: "application",
    "aria-label": "3-D views: arrow keys turn them, + and - zoom, Home shows all" },
    ...canvases.map((canvas, i) => make("figure", {}, make("figcaption", {}, meshes[i].caption), canvas)));
  const bar = make("div", { className: "bar" });
  place.replaceChildren(bar, turned);
  shown = { viewer: new Viewer(turned, canvases, meshes, facts.colours), place };
  bar.append(...controls(shown.viewer, meshes.some((mesh) => mesh.residuals)));
}

function closeViewer() {
  if (!shown) return;
  shown.viewer.end();
  shown.place.replaceChildren();
  shown = null;
}

/** Return a checkbox or a radio button with its label. */
function choice(type, label, properties, onChange) {
  const input = make("input", { type, ...properties });
  input.addEventListener("change", () => onChange(input.checked));
  return make("label", {}, input, " ", label);
}

function controls(viewer, hasResiduals) {
  const legend = make("p", { className: "legend" });
  const colour = (number) => { viewer.colourBy(number); legend.replaceChildren(...legendOf(number)); };
  const name = `colours-${Math.random()}`; // radio buttons of other viewers are another group
  const buttons = COLOURINGS.map((label, i) => choice("radio", label,
    { name, checked: i === 0, disabled: i === 2 && !hasResiduals }, () => colour(i)));
  const reset = make("button", { type: "button" }, "Reset view");
  reset.addEventListener("click", () => viewer.reset());
  return [
    make("fieldset", {}, make("legend", {}, "Colours"), ...buttons),
    make("fieldset", {}, make("legend", {}, "Surface"),
      choice("checkbox", "Flat shading", { checked: true }, (on) => viewer.shadeFlat(on)),
      choice("checkbox", "Wireframe", {}, (on) => viewer.showEdges(on))),
    cutControls(viewer), reset, legend,
  ];
}

/** Return the decimals by which thousandths of a length can be told apart. */
function decimals(length) { return Math.min(20, Math.max(0, Math.ceil(3 - Math.log10(length || 1)))); }

function cutControls(viewer) {
  const axis = make("select", { "aria-label": "Axis of the cutting plane" },
    make("option", { value: "" }, "none"), ...AXES.map((name) => make("option", { value: name }, name)));
  const slider = make("input", { type: "range", min: 0, max: 1000, value: 500, disabled: true,
    "aria-label": "Position of the cutting plane" });
  const side = make("input", { type: "checkbox", disabled: true });
  const where = make("output", {}, "");
  const update = () => {
    const i = AXES.indexOf(axis.value), low = viewer.low[i], high = viewer.high[i];
    slider.disabled = side.disabled = i < 0;
    const at = i < 0 ? 0 : low + (slider.value / 1000) * (high - low);
    where.value = i < 0 ? "" : `${AXES[i]} = ${at.toFixed(decimals(high - low))}`;
    viewer.cut(i < 0 ? null : i, at, side.checked);
  };
  for (const input of [axis, slider, side]) input.addEventListener("input", update);
  return make("fieldset", { className: "cut" }, make("legend", {}, "Cutting plane"),
    axis, slider, where, make("label", {}, side, " other side"));
}

/** Return what the colours mean. */
function legendOf(number) {
  if (number === 1) return ["Red, green and blue are (1 + normal)/2 along x, y and z."];
  if (number === 0) return [];
  const { pierced, touching, apart, unknown, full } = facts.colours;
  const swatch = (colour, label) => {
    const square = make("span", { className: "swatch" });
    square.style.backgroundColor = `rgb(${colour})`;
    return make("span", {}, square, ` ${label}`);
  };
  return [swatch(pierced, `pierces the samples' balls by ${full} voxel or more`), swatch(touching, "touches them"),
    swatch(apart, `does not reach them by ${full} voxel or more`), swatch(unknown, "no sample is near")];
}

/** Return the element of a file; what is in it is made when it is first opened. */
function elementOf(file) {
  const element = make("details", { className: `file ${file.status}` }, summaryOf(file));
  element.addEventListener("toggle", () => {
    const [, details] = element.children;
    if (!element.open) {
      if (shown && element.contains(shown.place)) closeViewer();
      details?.remove();
    } else if (!details) {
      element.append(detailsOf(file));
    }
  });
  return element;
}

/** Return a search field and a choice of orders for many files. */
function tools(elements, list) {
  const search = make("input", { type: "search", placeholder: "Find a file", "aria-label": "Find a file" });
  search.addEventListener("input", () => {
    const wanted = search.value.toLowerCase();
    facts.files.forEach((file, i) => { elements[i].hidden = !file.name.toLowerCase().includes(wanted); });
  });
  const order = make("select", { "aria-label": "Order" },
    ...Object.keys(ORDERS).map((name) => make("option", {}, name)));
  order.addEventListener("change", () => {
    const numbers = facts.files.map((_, i) => i), compare = ORDERS[order.value];
    if (compare) numbers.sort((a, b) => compare(facts.files[a], facts.files[b]));
    list.append(...numbers.map((i) => elements[i]));
  });
  return make("div", { className: "tools" }, search, order);
}

head();
const elements = facts.files.map(elementOf);
const list = make("div", { className: "list" }, ...elements);
if (elements.length >= SEARCHED_FROM) document.getElementById("files").append(tools(elements, list));
document.getElementById("files").append(list);
if (elements.length === 1) elements[0].open = true;
