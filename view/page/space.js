// The 3D view: the points of the depth image, the shapes and the camera, from any viewpoint. It is drawn only after a change.

import {
    BufferAttribute, BufferGeometry, DataTexture, DirectionalLight, DynamicDrawUsage, GLSL3, GridHelper, Group, HemisphereLight, Matrix4,
    OrbitControls, PerspectiveCamera, Points, RGBAFormat, Scene, ShaderMaterial, Vector3, WebGLRenderer,
} from "./three/three.min.js";
import { SCALE } from "./colours.js";
import { drawLabels } from "./labels.js";
import { dispose, frustum, shape, trail } from "./shapes.js";

const VERTEX = `
precision highp float;
in float depth;
uniform int columns;
uniform float step, scale, near, far, size;
uniform vec4 lens;   // fx, fy, cx, cy
out float part;
void main() {
    vec2 pixel = step * vec2(gl_VertexID % columns, gl_VertexID / columns);
    float z = depth * scale;
    bool measured = depth > 0.5 && depth < 65534.5;
    vec4 seen = modelViewMatrix * vec4(z * (pixel - lens.zw) / lens.xy, z, 1.0);
    gl_Position = measured ? projectionMatrix * seen : vec4(0.0, 0.0, 2.0, 1.0);
    gl_PointSize = clamp(size * z / max(-seen.z, 0.01), 1.0, 12.0);
    part = clamp((z - near) / (far - near), 0.0, 1.0);
}`;
const FRAGMENT = `
precision highp float;
in float part;
uniform sampler2D colours;
out vec4 colour;
void main() {
    colour = vec4(texture(colours, vec2((part * 255.0 + 0.5) / 256.0, 0.5)).rgb * 0.85, 1.0);
}`;

/** Converts camera coordinates (x right, y down, z forward) to those of the drawing (y up, z backward). */
const FROM_CAMERA = new Matrix4().set(1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1);

/** Without a graphics card, the shortest time between drawings: the robot needs its processors. */
const SLOW_MS = 2000;
/** The same while the view is being turned. */
const TURNED_MS = 300;

export class SpaceView {
    #renderer;
    #text;
    #scene = new Scene();
    /** All parts in camera coordinates, and the pose of the camera. */
    #seen = new Group();
    #cloud;
    #parts = new Group();
    /** Parts that are no longer drawn and not disposed of yet. */
    #old = [];
    #grid = new GridHelper(12, 24, 0x33405a, 0x1d2533);
    /** The coordinates in which the grid was placed. */
    #laid;
    #eye = new PerspectiveCamera(50, 4 / 3, 0.02, 200);
    #controls;
    #frame;
    #trails;
    /** When it is drawn next, by which timer. */
    #due = Infinity;
    #timer;
    #isPlaced = false;
    #wantsPoints = true;
    /** Whether there is no graphics card. */
    isSlow = false;
    #drawn = -Infinity;
    #size = "";
    #upright = new Matrix4();
    /** The coordinates of the drawing. */
    coordinates = "camera";
    halo = 3;
    labels = true;
    chosen;

    constructor(canvas, text) {
        this.isSlow = isDrawnBySoftware();
        this.#renderer = new WebGLRenderer({ canvas, antialias: !this.isSlow, powerPreference: "low-power" });
        this.#renderer.setClearColor(0x07090d);
        this.#text = text.getContext("2d", { willReadFrequently: true });
        this.#cloud = cloud();
        this.#seen.matrixAutoUpdate = false;
        this.#seen.add(this.#cloud);
        const sun = new DirectionalLight(0xffffff, 1.6);
        sun.position.set(2, 4, 3);
        this.#scene.add(new HemisphereLight(0xdfe8ff, 0x30343c, 1.5), sun, this.#seen, this.#parts, this.#grid);
        this.#controls = new OrbitControls(this.#eye, canvas);
        this.#controls.addEventListener("change", () => this.#ask(TURNED_MS));
        new ResizeObserver(() => this.#ask()).observe(canvas);
    }

    set points(wanted) {
        this.#wantsPoints = wanted;
        this.#cloud.visible = wanted && Boolean(this.#frame?.pixels);
        this.#ask();
    }

    /** Shows a frame. */
    show(frame, range, trails) {
        [this.#frame, this.#trails] = [frame, trails];
        if (frame.pixels) {
            this.#fill(frame, range);
        }
        this.#cloud.visible = this.#wantsPoints && Boolean(frame.pixels);
        this.redraw();
        if (!this.#isPlaced) {
            this.look("free");
        }
    }

    /** Updates the shapes, with the present selection and settings. */
    redraw() {
        if (!this.#frame) {
            return;
        }
        const { origin, items, camera, pose, pixels } = this.#frame;
        const isWorld = this.coordinates === "world" && pose;
        this.#seen.matrix.copy(FROM_CAMERA);
        if (isWorld) {
            const flat = pose.flat();
            this.#upright = uprightFrom(pose);
            this.#seen.matrix.copy(this.#upright).multiply(new Matrix4().set(...flat, 0, 0, 0, 1));
        }
        if (pixels) {
            this.#layFloor(this.#frame, isWorld ? "world" : "camera");
        }
        const old = [...this.#parts.children, ...this.#seen.children].filter((part) => part !== this.#cloud);
        old.forEach((part) => part.removeFromParent());
        this.#old.push(...old);
        items.forEach((item) => this.#seen.add(shape(item, this.halo, item.id !== undefined && item.id === this.chosen)));
        this.#seen.add(frustum(camera, 0.22));
        for (const item of items) {
            const points = this.#trails.of(origin, item.id, isWorld ? "world" : "camera");
            if (points.length > 1) {
                const drawn = trail(points, item);
                drawn.applyMatrix4(isWorld ? this.#upright : FROM_CAMERA);
                this.#parts.add(drawn);
            }
        }
        this.#ask();
    }

    /** Changes the viewpoint: "free" from a corner, "eye" from the camera, "side", "top". */
    look(from) {
        const { camera } = this.#frame ?? {};
        if (!camera) {
            return;
        }
        this.#isPlaced = true;
        const middle = this.#middle();
        const away = middle.z;
        const place = (point) => new Vector3(...point).applyMatrix4(this.#seen.matrix);
        const [target, lens] = [place(from === "eye" ? [0, 0, away] : middle.toArray()), place([0, 0, 0])];
        // From above, the far side is at the top of the drawing.
        const back = lens.clone().sub(target).setY(0).normalize().multiplyScalar(0.01);
        const places = {
            free: place([0.7 * away, -0.6 * away, 0.1 * away]),
            eye: place([0, 0, -0.02]),
            side: place([1.35 * away, 0, middle.z]),
            top: target.clone().add(new Vector3(0, 1.5 * away, 0)).add(back),
        };
        this.#eye.fov = from === "eye" ? (2 * Math.atan(camera.height / 2 / camera.fy) * 180) / Math.PI : 50;
        this.#eye.position.copy(places[from]);
        this.#controls.target.copy(target);
        this.#controls.update();
        this.#ask();
    }

    /** The approximate middle of the objects, or else of the measured points, on the camera's axis. */
    #middle() {
        const { pixels, image, items } = this.#frame;
        if (items.length > 0) {
            return new Vector3(0, 0, items.reduce((sum, item) => sum + item.center[2], 0) / items.length);
        }
        const measured = pixels ? [...pixels.filter((depth, i) => i % 97 === 0 && depth > 0 && depth < 65535)].sort((a, b) => a - b) : [];
        if (measured.length > 0) {
            return new Vector3(0, 0, measured[Math.floor(measured.length / 2)] * image.scale);
        }
        return new Vector3(0, 0, 2);
    }

    #fill({ image, pixels, camera }, { near, far }) {
        const geometry = this.#cloud.geometry;
        let depth = geometry.getAttribute("depth");
        if (!depth || depth.count !== pixels.length) {
            geometry.dispose();
            depth = new BufferAttribute(new Uint16Array(pixels.length), 1);
            depth.setUsage(DynamicDrawUsage);
            geometry.setAttribute("depth", depth);
            geometry.setDrawRange(0, pixels.length);
        }
        depth.array.set(pixels);
        depth.needsUpdate = true;
        const { uniforms } = this.#cloud.material;
        uniforms.columns.value = image.columns;
        uniforms.step.value = image.step;
        uniforms.scale.value = image.scale;
        uniforms.lens.value = [camera.fx, camera.fy, camera.cx, camera.cy];
        [uniforms.near.value, uniforms.far.value] = [near, far];
    }

    /** Places the grid at the height of the lowest points; moves it smoothly within the same coordinates. */
    #layFloor({ pixels, image: { columns, step, scale }, camera }, coordinates) {
        const heights = [];
        const e = this.#seen.matrix.elements;
        [this.#grid.position.x, this.#grid.position.z] = [e[12], e[14]];
        for (let i = 0; i < pixels.length; i += 211) {
            if (pixels[i] > 0 && pixels[i] < 65535) {
                const z = pixels[i] * scale;
                const x = (z * ((i % columns) * step - camera.cx)) / camera.fx;
                const y = (z * (Math.floor(i / columns) * step - camera.cy)) / camera.fy;
                heights.push(e[1] * x + e[5] * y + e[9] * z + e[13]);
            }
        }
        if (heights.length > 0) {
            heights.sort((a, b) => a - b);
            const floor = heights[Math.floor(heights.length * 0.01)];
            const isFar = this.#laid !== coordinates || Math.abs(floor - this.#grid.position.y) > 0.3;
            this.#grid.position.y += (floor - this.#grid.position.y) * (isFar ? 1 : 0.05);
            this.#laid = coordinates;
        }
    }

    /** Requests a drawing soon, once for all changes until then. */
    #ask(slow = SLOW_MS) {
        const due = this.isSlow ? this.#drawn + slow : 0;
        if (due < this.#due) {
            clearTimeout(this.#timer);
            this.#due = due;
            this.#timer = setTimeout(() => requestAnimationFrame(() => this.#draw()), Math.max(0, due - performance.now()));
        }
    }

    #draw() {
        [this.#due, this.#drawn] = [Infinity, performance.now()];
        const canvas = this.#renderer.domElement;
        const [width, height] = [canvas.clientWidth, canvas.clientHeight];
        if (width === 0) {
            return;
        }
        const ratio = this.isSlow ? 1 : Math.min(window.devicePixelRatio || 1, 2);
        const size = [width, height, ratio].join();
        if (size !== this.#size) {
            this.#size = size;
            this.#renderer.setPixelRatio(ratio);
            this.#renderer.setSize(width, height, false);
        }
        this.#eye.aspect = width / height;
        this.#eye.updateProjectionMatrix();
        if (this.#frame?.image) {
            const perMetre = (height * ratio) / 2 / Math.tan((this.#eye.fov * Math.PI) / 360);
            this.#cloud.material.uniforms.size.value = (1.25 * perMetre * this.#frame.image.step) / this.#frame.camera.fx;
        }
        this.#renderer.render(this.#scene, this.#eye);
        // Only now: the new parts use the shaders of the old ones, which would have to be compiled again.
        this.#old.splice(0).forEach(dispose);
        this.#write(width, height, ratio);
    }

    #write(width, height, ratio) {
        const { canvas } = this.#text;
        [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
        this.#text.setTransform(ratio, 0, 0, ratio, 0, 0);
        if (!this.labels || !this.#frame) {
            return;
        }
        const named = this.#frame.items.map((item) => ({ item, box: this.#box(item, width, height) })).filter(({ box }) => box);
        drawLabels(this.#text, named, width, height, this.chosen);
    }

    /** The approximate box of an item in the drawing; null if it is behind the viewpoint or outside. */
    #box(item, width, height) {
        const centre = new Vector3().fromArray(item.center).applyMatrix4(this.#seen.matrix);
        const reach = Math.max(item.radius_at_center, (item.length ?? 0) / 2);
        const seen = centre.clone().applyMatrix4(this.#eye.matrixWorldInverse);
        if (seen.z > -0.05) {
            return null;
        }
        const size = ((reach / -seen.z) * height) / 2 / Math.tan((this.#eye.fov * Math.PI) / 360);
        centre.project(this.#eye);
        const [x, y] = [((centre.x + 1) / 2) * width, ((1 - centre.y) / 2) * height];
        const inside = x > 0 && y > 0 && x < width && y < height;
        return inside ? { left: x - size, right: x + size, top: y - size, bottom: y + size } : null;
    }
}

/** Whether there is no graphics card, as far as the browser reveals it. */
function isDrawnBySoftware() {
    const gl = document.createElement("canvas").getContext("webgl2");
    if (!gl) {
        return true;
    }
    const told = gl.getExtension("WEBGL_debug_renderer_info");
    const name = gl.getParameter(told ? told.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
    gl.getExtension("WEBGL_lose_context")?.loseContext();
    return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

function cloud() {
    const colours = new DataTexture(SCALE, 256, 1, RGBAFormat);
    colours.needsUpdate = true;
    const uniforms = { columns: { value: 1 }, step: { value: 1 }, scale: { value: 0.001 }, near: { value: 0 }, far: { value: 1 }, size: { value: 1 },
        lens: { value: [1, 1, 0, 0] }, colours: { value: colours } };
    const material = new ShaderMaterial({ vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms, glslVersion: GLSL3 });
    const points = new Points(new BufferGeometry(), material);
    points.frustumCulled = false;
    return points;
}

/** The rotation of the world's up axis (the axis nearest to the camera's up) to that of the drawing. */
function uprightFrom(pose) {
    const up = pose.map((row) => -row[1]);
    const axis = up.reduce((best, part, index) => (Math.abs(part) > Math.abs(up[best]) ? index : best), 0);
    const sign = Math.sign(up[axis]) || 1;
    const rows = [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
    rows[1][axis] = sign;
    rows[0][(axis + 2) % 3] = 1;
    const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    rows[2] = cross(rows[0], rows[1]);
    return new Matrix4().set(...rows[0], 0, ...rows[1], 0, ...rows[2], 0, 0, 0, 0, 1);
}
