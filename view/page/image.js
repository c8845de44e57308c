// The depth image in colours, with the outlines of objects or tracks.

import { HOLE, SCALE, colourOf, css } from "./colours.js";
import { drawLabels } from "./labels.js";
import { isSecond, sureness } from "./words.js";

export class ImageView {
    #canvas;
    #context;
    #small = document.createElement("canvas");
    #paper;
    #frame;
    #data;
    chosen;
    labels = true;

    constructor(canvas, probe) {
        this.#canvas = canvas;
        // Drawn by the processor: there is little to draw, and without a graphics card the alternative takes ten times as long.
        this.#context = canvas.getContext("2d", { willReadFrequently: true });
        this.#paper = this.#small.getContext("2d", { willReadFrequently: true });
        canvas.addEventListener("pointermove", (event) => { probe.textContent = this.#depthAt(event); });
        canvas.addEventListener("pointerleave", () => { probe.textContent = ""; });
        new ResizeObserver(() => this.draw()).observe(canvas);
    }

    /** Shows a frame; without an image only the outlines. */
    show(frame, range) {
        this.#frame = frame;
        this.#canvas.parentElement.style.aspectRatio = `${frame.camera.width} / ${frame.camera.height}`;
        if (frame.pixels) {
            this.#paint(frame, range);
        }
        this.draw();
    }

    /** Colours the pixels of the frame, as many as were sent. */
    #paint({ image, pixels }, { near, far }) {
        const { columns, rows, scale } = image;
        if (this.#small.width !== columns || this.#small.height !== rows || !this.#data) {
            [this.#small.width, this.#small.height] = [columns, rows];
            this.#data = this.#paper.createImageData(columns, rows);
        }
        const colours = new Uint32Array(SCALE.buffer);
        const painted = new Uint32Array(this.#data.data.buffer);
        const [low, slope] = [near / scale, (255 * scale) / (far - near)];
        const hole = new Uint32Array(new Uint8Array([...HOLE, 255]).buffer)[0];
        for (let i = 0; i < pixels.length; i += 1) {
            const depth = pixels[i];
            const index = Math.min(Math.max((depth - low) * slope, 0), 255) | 0;
            painted[i] = depth === 0 || depth === 65535 ? hole : colours[index];
        }
        this.#paper.putImageData(this.#data, 0, 0);
    }

    /** Redraws the present frame. */
    draw() {
        const [width, height] = [this.#canvas.clientWidth, this.#canvas.clientHeight];
        const ratio = Math.min(window.devicePixelRatio || 1, 2);
        if (!this.#frame || width === 0) {
            return;
        }
        const [pixels, rows] = [Math.round(width * ratio), Math.round(height * ratio)];
        if (this.#canvas.width !== pixels || this.#canvas.height !== rows) {
            [this.#canvas.width, this.#canvas.height] = [pixels, rows];
        }
        const { camera, image, items } = this.#frame;
        const context = this.#context;
        context.setTransform(ratio, 0, 0, ratio, 0, 0);
        context.clearRect(0, 0, width, height);
        const scale = width / camera.width;
        if (image) {
            // Each pixel that was sent stands for `step` pixels along the row and the column.
            context.imageSmoothingEnabled = image.step > 1;
            context.drawImage(this.#small, 0, 0, image.columns * image.step * scale, image.rows * image.step * scale);
        }
        context.save();
        context.lineJoin = "round";
        items.forEach((item) => this.#outline(item, scale));
        context.restore();
        if (this.labels) {
            const named = items.map((item) => ({ item, box: box(item, scale, width, height) })).filter(({ box }) => box);
            drawLabels(context, named, width, height, this.chosen);
        }
    }

    /** Draws an outline: stronger for more certain items, dashed for tentative or coasting ones. */
    #outline(item, scale) {
        const context = this.#context;
        const [colour, sure] = [colourOf(item), sureness(item)];
        const isChosen = item.id !== undefined && item.id === this.chosen;
        const width = 1.2 + 1.6 * sure + (isChosen ? 1.5 : 0);
        const seen = path(item.seen, scale);
        context.setLineDash([]);
        context.lineWidth = width + 2.4;
        context.strokeStyle = "rgb(5 7 10 / 0.6)";
        context.stroke(seen);
        context.setLineDash([3, 3]);
        context.lineWidth = 1;
        context.strokeStyle = css(colour, 0.25 + 0.4 * sure);
        context.stroke(path(item.hidden, scale));
        // The outline of a second variant is dashed, so that the first one shows through.
        context.setLineDash({ tentative: [2, 4], coasting: [9, 6] }[item.state] ?? (isSecond(item) ? [5, 5] : []));
        context.lineWidth = width;
        context.strokeStyle = isChosen ? "#fff" : css(colour, 0.4 + 0.6 * sure);
        context.stroke(seen);
        context.setLineDash([]);
    }

    #depthAt(event) {
        const { pixels, image, camera } = this.#frame ?? {};
        if (!pixels) {
            return "";
        }
        const u = Math.floor((event.offsetX / this.#canvas.clientWidth) * camera.width);
        const v = Math.floor((event.offsetY / this.#canvas.clientHeight) * camera.height);
        const depth = pixels[Math.floor(v / image.step) * image.columns + Math.floor(u / image.step)];
        const text = depth === 0 || depth === 65535 || depth === undefined ? "nothing" : `${(depth * image.scale).toFixed(3)} m`;
        return `(${u}, ${v}): ${text}`;
    }
}

/** A path of polylines u0, v0, u1, v1, ..; pixel centres lie at integers. */
function path(lines, scale) {
    const path = new Path2D();
    for (const line of lines) {
        for (let i = 0; i < line.length; i += 2) {
            const [x, y] = [(line[i] + 0.5) * scale, (line[i + 1] + 0.5) * scale];
            if (i === 0) {
                path.moveTo(x, y);
            } else {
                path.lineTo(x, y);
            }
        }
    }
    return path;
}

/** The bounding box of an outline in the drawing; null if it lies outside. */
function box(item, scale, width, height) {
    const all = item.seen.flat();
    if (all.length === 0) {
        return null;
    }
    const [us, vs] = [all.filter((_, i) => i % 2 === 0), all.filter((_, i) => i % 2 === 1)];
    const [left, right] = [Math.min(...us) * scale, Math.max(...us) * scale];
    const [top, bottom] = [Math.min(...vs) * scale, Math.max(...vs) * scale];
    if (right < 0 || bottom < 0 || left > width || top > height) {
        return null;
    }
    return { left: Math.max(left, 0), right: Math.min(right, width), top: Math.max(top, 0), bottom: Math.min(bottom, height) };
}
