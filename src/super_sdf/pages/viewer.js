"use strict";
// Meshes side by side from one camera. Nothing here knows of reports: see page.js for these.

// Two triangles of a mesh are lit, coloured and cut by the same few lines whatever the switches say,
// so one shader is shorter than the library's materials for each case would be.
const VERTEX_SHADER = `
attribute vec3 residualColour;
varying vec3 place, direction, shade;
void main() {
  place = position;
  direction = normal;
  shade = residualColour;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}`;
const FRAGMENT_SHADER = `
uniform int colouring;  // 0 plain, 1 normals, 2 residuals
uniform bool facets;
uniform bool edges;
uniform vec4 cut;  // what lies beyond this plane is not drawn
uniform vec3 light;
varying vec3 place, direction, shade;
void main() {
  if (dot(cut.xyz, place) > cut.w) discard;
  if (edges) { gl_FragColor = vec4(0.08, 0.1, 0.14, 0.55); return; }
  // without light, so that the inside behind a cut looks like a solid that was sawn through
  if (!gl_FrontFacing) { gl_FragColor = vec4(0.86, 0.62, 0.33, 1.0); return; }
  vec3 normal = normalize(facets ? cross(dFdx(place), dFdy(place)) : direction);
  if (colouring == 1) { gl_FragColor = vec4(0.5 * normal + 0.5, 1.0); return; }
  float lit = max(dot(normal, light), 0.0);
  vec3 own = colouring == 2 ? shade : vec3(0.725, 0.78, 0.875);
  // residuals mostly without light, so that they match the legend
  gl_FragColor = vec4(own * (colouring == 2 ? 0.7 + 0.3 * lit : 0.25 + 0.75 * lit), 1.0);
}`;

const AXES = ["x", "y", "z"];
const FROM = [0.6, -1, 0.5]; // the viewer's direction at first: right, front and above, z up
const LIGHT = [0.35, 0.45, 1]; // beside the viewer's head: right, up, towards the mesh
const UNKNOWN = -128; // the byte of an unknown residual, see packing.py
const TURN = 0.12; // radians for each press of an arrow key
const ZOOM = 0.85; // what is seen after "+", as a share of what was

/** Return the numbers whose differences are given, modulo the size of their type. */
function summed(numbers) {
  for (let i = 1; i < numbers.length; i++) numbers[i] += numbers[i - 1];
  return numbers;
}

/** Return the bytes that were compressed and written in base64. */
async function unpackedBytes(text) {
  const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

/** Return positions, corners and residuals of a mesh as packing.py has packed them. */
async function unpack(packed) {
  const bytes = await unpackedBytes(packed.data);
  const n = packed.vertices, m = packed.triangles;
  return {
    ...packed,
    places: summed(new Uint16Array(bytes.slice(0, 6 * n))), // all x, then all y, then all z
    corners: summed(new Uint32Array(bytes.slice(6 * n, 6 * n + 12 * m))),
    residuals: packed.residuals ? new Int8Array(bytes, 6 * n + 12 * m, n) : null,
  };
}

/** Return the box of meshes: two corners. */
function boxOf(meshes) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (const mesh of meshes) {
    for (let i = 0; i < mesh.places.length; i++) {
      const axis = Math.floor(i / mesh.vertices);
      const x = mesh.low[axis] + mesh.step * mesh.places[i];
      low[axis] = Math.min(low[axis], x);
      high[axis] = Math.max(high[axis], x);
    }
  }
  return [low, high];
}

/** Return the library's geometry of a mesh, relative to a point so that 32 bits are enough. */
function geometryOf(mesh, middle, scale) {
  const n = mesh.vertices, positions = new Float32Array(3 * n);
  for (let i = 0; i < 3 * n; i++) {
    const axis = Math.floor(i / n);
    positions[3 * (i - axis * n) + axis] = mesh.low[axis] - middle[axis] + mesh.step * mesh.places[i];
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  geometry.setIndex(new THREE.BufferAttribute(mesh.corners, 1));
  geometry.computeVertexNormals();
  const colours = new THREE.BufferAttribute(residualColours(mesh, scale), 3, true);
  geometry.setAttribute("residualColour", colours);
  return geometry;
}

/** Return red, green and blue of each vertex; all unknown if the mesh has no residuals. */
function residualColours(mesh, scale) {
  const colours = new Uint8Array(3 * mesh.vertices);
  for (let i = 0; i < mesh.vertices; i++) {
    colours.set(residualColour(mesh.residuals ? mesh.residuals[i] : UNKNOWN, scale), 3 * i);
  }
  return colours;
}

function residualColour(byte, scale) {
  if (byte === UNKNOWN) return scale.unknown;
  const end = byte < 0 ? scale.pierced : scale.apart, share = Math.abs(byte) / 127;
  return scale.touching.map((white, i) => Math.round((1 - share) * white + share * end[i]));
}

class Viewer {
  /**
   * Show meshes in a canvas each.
   *
   * turned: the element that holds the canvases; turning anywhere in it turns all views.
   */
  constructor(turned, canvases, meshes, scale) {
    [this.low, this.high] = boxOf(meshes);
    this.middle = this.low.map((x, axis) => (x + this.high[axis]) / 2);
    this.radius = Math.hypot(...this.low.map((x, axis) => this.high[axis] - x)) / 2 || 1;
    this.uniforms = {
      colouring: { value: 0 }, facets: { value: true }, cut: { value: new THREE.Vector4(0, 0, 0, 1) },
      light: { value: new THREE.Vector3() },
    };
    this.camera = new THREE.OrthographicCamera();
    this.camera.up.set(0, 0, 1);
    this.views = canvases.map((canvas, i) => this.makeView(canvas, geometryOf(meshes[i], this.middle, scale)));
    this.turned = turned;
    this.controls = new THREE.OrbitControls(this.camera, turned);
    this.controls.addEventListener("change", () => this.draw());
    this.controls.minZoom = 0.2;
    this.controls.maxZoom = 200;
    turned.addEventListener("keydown", (event) => this.onKey(event));
    this.watch = new ResizeObserver(() => this.draw());
    this.watch.observe(turned);
    this.reset();
  }

  makeView(canvas, geometry) {
    const renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    const material = (edges) => new THREE.ShaderMaterial({
      vertexShader: VERTEX_SHADER, fragmentShader: FRAGMENT_SHADER, side: THREE.DoubleSide,
      uniforms: { ...this.uniforms, edges: { value: edges } }, wireframe: edges, transparent: edges,
      polygonOffsetFactor: 1, polygonOffsetUnits: 1,
    });
    const scene = new THREE.Scene(), wires = new THREE.Mesh(geometry, material(true));
    const surface = new THREE.Mesh(geometry, material(false));
    wires.visible = false;
    scene.add(surface, wires);
    return { canvas, renderer, scene, surface, wires };
  }

  /** Look from the front, the right and above at all of it. */
  reset() {
    this.camera.position.set(...FROM).setLength(4 * this.radius);
    this.controls.target.set(0, 0, 0);
    this.controls.update();
    this.camera.zoom = this.zoomToFit();
    this.controls.update();
    this.draw();
  }

  /** Return the zoom at which the box of all meshes just fits; at 1 the ball around it does. */
  zoomToFit() {
    const [{ canvas }] = this.views, half = this.fit(canvas.clientWidth / canvas.clientHeight || 1);
    const turn = this.camera.quaternion.clone().invert(), corner = new THREE.Vector3();
    let most = 0;
    for (let i = 0; i < 8; i++) {
      const signs = [i & 1, i & 2, i & 4].map((bit) => (bit ? 0.5 : -0.5));
      corner.set(...signs.map((sign, axis) => sign * (this.high[axis] - this.low[axis]))).applyQuaternion(turn);
      most = Math.max(most, Math.abs(corner.x) / half[0], Math.abs(corner.y) / half[1]);
    }
    return most ? 0.96 / most : 1;
  }

  colourBy(number) { this.uniforms.colouring.value = number; this.draw(); }

  shadeFlat(isFlat) { this.uniforms.facets.value = isFlat; this.draw(); }

  showEdges(areShown) {
    for (const { surface, wires } of this.views) {
      wires.visible = areShown;
      surface.material.polygonOffset = areShown; // a little behind its edges
    }
    this.draw();
  }

  /**
   * Cut at a coordinate on an axis, 0 to 2; null: do not cut.
   *
   * The half that is away from the first point of view is kept, so that the cut is seen; or the other.
   */
  cut(axis, at = 0, keepOther = false) {
    const side = (FROM[axis] < 0) === keepOther ? 1 : -1, plane = [0, 0, 0];
    if (axis !== null) plane[axis] = side;
    this.uniforms.cut.value.set(...plane, axis === null ? 1 : side * (at - this.middle[axis]));
    this.draw();
  }

  onKey(event) {
    const keys = {
      ArrowLeft: () => this.controls.rotateLeft(TURN), ArrowRight: () => this.controls.rotateLeft(-TURN),
      ArrowUp: () => this.controls.rotateUp(TURN), ArrowDown: () => this.controls.rotateUp(-TURN),
      "+": () => this.controls.dollyIn(ZOOM), "-": () => this.controls.dollyOut(ZOOM), Home: () => this.reset(),
    };
    if (!(event.key in keys) || event.ctrlKey || event.metaKey || event.altKey) return;
    keys[event.key]();
    event.preventDefault();
  }

  /** Draw all views with the next picture of the screen, however often it is asked for before. */
  draw() {
    if (!this.waiting) this.waiting = requestAnimationFrame(() => { this.waiting = 0; this.drawNow(); });
  }

  drawNow() {
    this.uniforms.light.value.set(...LIGHT).normalize().applyQuaternion(this.camera.quaternion);
    for (const { canvas, renderer, scene } of this.views) {
      const wide = canvas.clientWidth, tall = canvas.clientHeight;
      if (!wide || !tall) continue;
      renderer.setSize(wide, tall, false);
      this.fit(wide / tall);
      renderer.render(scene, this.camera);
    }
  }

  /** Let the camera see the ball around all meshes; return half the width and height that it sees. */
  fit(aspect) {
    const half = 1.02 * this.radius * Math.max(1, 1 / aspect);
    Object.assign(this.camera, { left: -half * aspect, right: half * aspect, top: half, bottom: -half });
    Object.assign(this.camera, { near: 0, far: 8 * this.radius });
    this.camera.updateProjectionMatrix();
    return [half * aspect, half];
  }

  /** Give back the memory of the graphics card; browsers allow few viewers at a time. */
  end() {
    cancelAnimationFrame(this.waiting);
    this.watch.disconnect();
    this.controls.dispose();
    for (const { renderer, surface } of this.views) {
      surface.geometry.dispose();
      renderer.dispose();
      renderer.forceContextLoss();
    }
  }
}
