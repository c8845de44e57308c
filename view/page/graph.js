// The graph of stages from top to bottom: the rate and load of each stage, the rate and losses of each topic, and the stages'
// counters.

import { element } from "./elements.js";
import { count, milliseconds } from "./words.js";

/** Height of a stage, and of the gap below it. */
const [HIGH, GAP] = [50, 56];
/** Width of a stage, and of the text beside an arrow. */
const [BOX, BESIDE] = [300, 320];

const svg = (tag, attributes, ...children) => {
    const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
    Object.entries(attributes).forEach(([key, value]) => element.setAttribute(key, value));
    element.append(...children);
    return element;
};

const text = (x, y, name, content) => svg("text", { x, y, class: name }, content);

/** The stages in rows: each below all stages whose topics it reads. */
function rows(stages) {
    const depth = new Map(stages.map(({ name }) => [name, 0]));
    for (let round = 0; round < stages.length; round += 1) {
        for (const reader of stages) {
            for (const writer of stages.filter(({ outputs }) => outputs.some((topic) => reader.inputs.includes(topic)))) {
                if (writer !== reader) {
                    depth.set(reader.name, Math.max(depth.get(reader.name), Math.min(depth.get(writer.name) + 1, stages.length)));
                }
            }
        }
    }
    const levels = [...new Set(depth.values())].sort((a, b) => a - b);
    return levels.map((level) => stages.filter(({ name }) => depth.get(name) === level));
}

/** The counters with their rates since an earlier look, as a list of { name, value, rate }, the largest first. */
function counted(now, before, seconds) {
    const entries = Object.entries(now ?? {});
    const rated = entries.map(([name, value]) => ({ name, value, rate: Math.max(0, value - (before?.[name] ?? value)) / seconds }));
    return rated.sort((a, b) => b.value - a.value);
}

export class GraphView {
    #place;
    #counters;
    #before = { at: 0, activity: null };

    constructor(place, counters) {
        [this.#place, this.#counters] = [place, counters];
    }

    /** Shows the stages, or the text `instead` if there are none. */
    show(graph, instead) {
        if (!graph) {
            this.#place.replaceChildren(none(instead));
            this.#counters.replaceChildren(none(instead));
            return;
        }
        const seconds = Math.max((performance.now() - this.#before.at) / 1000, 0.5);
        const before = this.#before.activity?.pipeline === graph.activity.pipeline ? this.#before.activity : null;
        this.#draw(graph, before, seconds);
        this.#count(graph.activity, before, seconds);
        this.#before = { at: performance.now(), activity: graph.activity };
    }

    #draw({ stages, activity }, before, seconds) {
        const levels = rows(stages);
        const widest = Math.max(...levels.map((level) => level.length));
        // A unit is a pixel if there is room, so text has its usual size.
        const width = Math.max(this.#place.clientWidth - 24, BESIDE, widest * (BOX + 24));
        const lone = Math.max(Math.min((width - BOX) / 2, width - BOX - 130), Math.min(24, width - BOX - 4));
        const place = new Map();
        levels.forEach((level, row) => {
            level.forEach((stage, column) => {
                const x = width * ((column + 0.5) / level.length) - BOX / 2;
                // A single column leaves room on its right for the text beside the arrows.
                place.set(stage.name, { x: widest === 1 ? lone : x, y: row * (HIGH + GAP) + 2, row });
            });
        });
        const size = { width, height: levels.length * (HIGH + GAP) - GAP + 6 };
        const [arrows, told] = [svg("g", { "aria-hidden": "true" }), new Map(stages.map(({ name }) => [name, []]))];
        for (const reader of stages) {
            for (const writer of stages) {
                for (const topic of writer.outputs.filter((topic) => reader.inputs.includes(topic))) {
                    const [from, to] = [place.get(writer.name), place.get(reader.name)];
                    arrows.append(...arrow(from, to, reader.drives > 0 && reader.inputs[0] === topic));
                    if (to.row === from.row + 1) {
                        told.get(reader.name).push(...beside(writer, reader, topic, to, { activity, before, seconds }));
                    }
                }
            }
        }
        // A screen reader reads each stage with its inputs; no arrow crosses a text.
        const items = stages.map((stage) => {
            const { name } = stage;
            return svg("g", { role: "listitem" }, ...box(stage, place.get(name), activity), ...told.get(name));
        });
        this.#place.replaceChildren(svg("svg", { ...size, role: "list", "aria-label": "Stages" }, arrows, ...items));
        // A graph that does not fit can be scrolled with the arrow keys, too.
        if (this.#place.scrollWidth > this.#place.clientWidth) {
            this.#place.tabIndex = 0;
        } else {
            this.#place.removeAttribute("tabindex");
        }
    }

    #count(activity, before, seconds) {
        const parts = activity.stages.flatMap((stage) => {
            const earlier = before?.stages.find((other) => other.stage === stage.stage);
            const found = counted(stage.found, earlier?.found, seconds);
            const reasons = counted(stage.counters, earlier?.counters, seconds);
            if (found.length + reasons.length === 0) {
                return [];
            }
            const most = Math.max(...[...found, ...reasons].map(({ value }) => value), 1);
            const bars = [...found.map((entry) => bar(entry, most, "count found")), ...reasons.map((entry) => bar(entry, most, "count"))];
            return [element("div", {}, element("h3", {}, stage.stage), ...bars)];
        });
        this.#counters.replaceChildren(...(parts.length > 0 ? parts : [none("no stage has counted anything")]));
    }
}

/**
 * An arrow from a stage to a reader of its output, to the next row or past some rows; dashed if the input does not drive the
 * reader.
 */
function arrow(from, to, drives) {
    const isNext = to.row === from.row + 1;
    const [x1, y1, x2, y2] = [from.x + 16, from.y + HIGH, to.x + 16, to.y - 6];
    // It stays inside the drawing if there is little room beside the boxes.
    const bend = Math.max(-40 - 10 * (to.row - from.row), -Math.min(from.x, to.x) / 0.75);
    // Its sideways part lies above the text beside it.
    const line = isNext
        ? `M${x1},${y1} C${x1},${y1 + 10} ${x2},${y1 + 4} ${x2},${y1 + 16} V${y2}`
        : `M${from.x},${from.y + HIGH / 2} C${from.x + bend},${y1} ${to.x + bend},${to.y} ${to.x - 6},${to.y + HIGH / 2}`;
    const head = isNext ? `M${x2 - 5},${y2 - 2} h10 l-5,8 z` : `M${to.x - 8},${to.y + HIGH / 2 - 5} v10 l8,-5 z`;
    return [svg("path", { d: line, class: drives ? "edge" : "edge side" }), svg("path", { d: head, class: "arrow" })];
}

/** The text beside the arrow from a stage in the row above. */
function beside(writer, reader, topic, to, { activity, before, seconds }) {
    const [x, y] = [to.x + 30, to.y - GAP / 2];
    const written = activity.topics.find((seen) => seen.topic === topic && seen.writer === writer.name);
    const same = (seen) => seen.topic === topic && seen.reader === reader.name;
    const [read, earlier] = [activity.inputs.find(same), before?.inputs.find(same)];
    const label = svg("text", { x, y: y - 3, class: "beside" }, svg("tspan", { class: "topic" }, topic));
    if (written) {
        const { rate_hz: rate, bandwidth_mbps: bandwidth } = written;
        const figures = `  ${rate.toFixed(1)} Hz · ${bandwidth.toFixed(bandwidth < 1 ? 3 : 1)} MB/s`;
        label.append(svg("tspan", { class: "figure" }, figures));
    }
    const line2 = svg("text", { x, y: y + 12, class: "beside figure" });
    if (read) {
        const age = `age ${milliseconds(read.latency_p50_ms)}, p99 ${milliseconds(read.latency_p99_ms)} · `;
        const isLossy = read.dropped + read.gaps > 0;
        line2.append(read.hop_p50_ms === null ? "" : age);
        line2.append(svg("tspan", isLossy ? { class: "warn" } : {}, lost(read, earlier, seconds)));
    }
    return [label, line2];
}

function lost(now, before, seconds) {
    const rate = before ? (now.dropped - before.dropped) / seconds : 0;
    const dropped = `${count(now.dropped)} dropped${rate >= 0.05 ? ` (${rate.toFixed(1)}/s)` : ""}`;
    return now.gaps > now.dropped ? `${dropped}, ${count(now.gaps)} missing` : dropped;
}

function box({ name, node, drives }, { x, y }, activity) {
    const stage = activity.stages.find((seen) => seen.stage === name);
    const drawn = [
        svg("rect", { x, y, width: BOX, height: HIGH, rx: 8, class: stage && stage.silent_s < 2 ? "box" : "box silent" }),
        svg("text", { x: x + 12, y: y + 20, class: "node" }, svg("tspan", { class: "name" }, name), `  ${node}`),
    ];
    if (!stage) {
        return [...drawn, text(x + 12, y + 39, "warn", "does not run")];
    }
    const starts = stage.starts > 1 ? ` · ${stage.starts} starts` : "";
    const time = drives > 0 || stage.compute_p50_ms !== null ? ` · ${milliseconds(stage.compute_p50_ms)}, p99 ${milliseconds(stage.compute_p99_ms)}` : "";
    const figures = svg("text", { x: x + 12, y: y + 39, class: "figure" }, svg("tspan", { class: "strong" }, `${stage.rate_hz.toFixed(1)} Hz`));
    figures.append(`${time} · ${stage.cpu_percent.toFixed(0)} % CPU${starts}`);
    return [...drawn, figures];
}

function bar({ name, value, rate }, most, kind) {
    const pace = rate > 0 ? `${rate.toFixed(rate < 10 ? 1 : 0)}/s` : "";
    const line = element("i", { style: `width: ${(100 * value) / most}%` });
    return element("div", { className: kind }, element("span", {}, name), element("b", {}, count(value)), element("span", {}, pace), line);
}

const none = (content) => element("p", { className: "none" }, content);
