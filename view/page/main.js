// The page: passes each answer of the server to the views.

import { DepthRange, SCALE } from "./colours.js";
import { element, swatch } from "./elements.js";
import { GraphView } from "./graph.js";
import { ImageView } from "./image.js";
import { ListView } from "./list.js";
import { follow, wish } from "./server.js";
import { SpaceView } from "./space.js";
import { Timeline } from "./timeline.js";
import { Trails } from "./trails.js";
import { isSecond, metres, milliseconds } from "./words.js";

/** The shortest time between updates of texts. */
const TEXT_MS = 200;
/** Without a graphics card, the shortest time between requests: the robot needs its processors. */
const SLOW_MS = 200;

const by = (id) => document.getElementById(id);

const range = new DepthRange();
const trails = new Trails();
const image = new ImageView(by("image"), by("probe"));
const space = openSpace();
const list = new ListView(by("list"), choose);
const graph = new GraphView(by("graph"), by("counters"));
const timeline = new Timeline(by("timeline"));
let frame = null;
let written = 0;
let isWriting = false;
let title = "";
/** Information about the frames. */
let about = { run: null, notice: null };
let variants = [];
/** Whether the page shows the last state of a run that is over. */
let isOld = false;
/** Whether the last answer could be shown; otherwise the notice says why not. */
let isAnswered = true;
/** When the last frames were shown, and the present epoch of each camera. */
let shown = [];
const epochs = new Map();

/** Creates the 3D view, or a remark if the browser cannot draw it. */
function openSpace() {
    try {
        return new SpaceView(by("space-image"), by("space-text"));
    } catch (error) {
        const why = "This browser has no WebGL 2, or it is switched off: space cannot be drawn.";
        by("space").append(element("div", { className: "empty" }, why));
        return null;
    }
}

/** Selects a track in all views, or deselects it. */
function choose(id) {
    image.chosen = image.chosen === id ? undefined : id;
    if (space) {
        space.chosen = image.chosen;
        space.redraw();
    }
    image.draw();
    list.show(frame, image.chosen);
}

/** Deselects the track: one of another run may have the same number. */
function forget() {
    if (image.chosen !== undefined) {
        choose(image.chosen);
    }
}

/** Records when a frame was shown, for the last two seconds and at least two frames. */
function countShown() {
    const now = performance.now();
    shown = [...shown.filter((at, index) => at > now - 2000 || index === shown.length - 1), now];
}

/** Shows the rate of frames, unless playback or the run stands still. */
function writeRate() {
    shown = timeline.goesOn ? shown : [];
    const [begin, end, gaps] = [shown[0], shown.at(-1), shown.length - 1];
    // An overdue frame counts as if it came now.
    const until = Math.max(end, performance.now() - (end - begin) / gaps);
    by("rate").textContent = gaps > 0 ? `${((1000 * gaps) / (until - begin)).toFixed(1)} Hz` : "–";
}

function showFrame(next) {
    const { origin, epoch } = next;
    if (epochs.has(origin) && epochs.get(origin) !== epoch) {
        forget();
    }
    epochs.set(origin, epoch);
    frame = next;
    if (frame.pixels) {
        range.follow(frame.pixels, frame.image.scale);
    }
    trails.follow(frame);
    image.show(frame, range);
    space?.show(frame, range, trails);
    countShown();
    if (!isWriting) {
        isWriting = true;
        setTimeout(writeTexts, Math.max(0, written + TEXT_MS - performance.now()));
    }
}

/** Updates the texts, less often than frames come, because nobody reads that fast. */
function writeTexts() {
    [isWriting, written] = [false, performance.now()];
    writeRate();
    [by("near").textContent, by("far").textContent] = range.far > 0 ? [metres(range.near), metres(range.far)] : ["", ""];
    by("sequence").textContent = String(frame.sequence);
    by("stamp").textContent = frame.stamp_s > 1e8 ? new Date(frame.stamp_s * 1000).toLocaleTimeString() : `${frame.stamp_s.toFixed(2)} s`;
    by("latency").textContent = milliseconds(isOld ? null : frame.latency_ms);
    list.show(frame, image.chosen);
    by("list-title").textContent = { tracks: "Tracks", objects: "Objects" }[frame.kind] ?? "Objects";
    by("list-note").textContent = counted();
    const hasPose = Boolean(frame.pose);
    by("frames").querySelectorAll("button").forEach((button) => {
        button.disabled = button.dataset.frame === "world" && !hasPose;
        button.title = button.disabled ? "the pose of the camera is not known" : "";
    });
}

/** Says how many objects were found in the frame, and by which variant. */
function counted() {
    const [all, at] = [frame.items, frame.source || `frame ${frame.sequence}`];
    if (variants.length === 0) {
        return `${all.length} in ${at}`;
    }
    if (!frame.compared) {
        return `${all.length} in ${at}; B has nothing of this frame`;
    }
    const only = (letter) => all.filter((item) => item.variant === letter && item.pair === undefined).length;
    return `${all.filter((item) => isSecond(item)).length} in both, ${only("a")} only in A, ${only("b")} only in B, in ${at}`;
}

/** Shows the colours of two compared variants. */
function showVariants() {
    const named = variants.map((name, index) => {
        const letter = "ab"[index];
        return element("span", {}, swatch({ variant: letter }), `${letter.toUpperCase()}: ${name}`);
    });
    by("variants").replaceChildren(...named);
    by("variants").hidden = named.length === 0;
}

/** Fills a selection with names, and hides it if there is no choice. */
function fill(select, names, chosen) {
    select.hidden = names.length < 2 && (names.length === 0 || names[0] === chosen);
    const isGone = names.length > 0 && !names.includes(chosen);
    const wanted = isGone ? [chosen, ...names] : names;
    const isSame = [...select.options].map(({ value }) => value).join("\n") === wanted.join("\n");
    if (!isSame) {
        select.replaceChildren(...wanted.map((name) => new Option(name, name)));
        if (isGone) {
            [select.options[0].text, select.options[0].disabled] = [chosen ? `${chosen} (over)` : "choose", true];
        }
    }
    if (!isSame || document.activeElement !== select) {
        select.value = chosen;
    }
}

function showNotice() {
    const waits = about.run?.paused && !frame ? "The run is paused: let it make a frame, or go on." : "";
    by("notice").textContent = about.notice ?? waits;
    by("notice").hidden = by("notice").textContent === "";
}

function showAbout(isRecording) {
    if (title !== about.title) {
        forget();
    }
    title = about.title;
    document.title = title ? `${title} – conicflow` : "conicflow";
    by("title").textContent = title;
    variants = about.variants;
    showVariants();
    showNotice();
    by("latency-vital").hidden = isRecording;
    fill(by("pipeline"), about.pipelines, title);
    fill(by("depth-topic"), about.depth_topics, about.depth_topic);
    by("title").hidden = !by("pipeline").hidden || variants.length > 0;
    // A recording has no information about stages.
    document.body.classList.toggle("recording", isRecording);
    graph.show(about.graph, "No stages are seen yet.");
}

/** Marks whether the page shows the present state. */
function showAge(isNow) {
    isOld = !isNow;
    document.body.classList.toggle("old", isOld);
    if (isOld) {
        by("latency").textContent = milliseconds(null);
    }
}

function showState(state) {
    const isWaiting = state === "good" && timeline.state === "waiting";
    by("link").dataset.state = isWaiting ? "waits" : state;
    by("link").textContent = state === "bad" ? "no answer" : timeline.state;
    by("link").toggleAttribute("data-paused", timeline.state === "paused");
}

function tell(state, text) {
    showState(state);
    if (state === "bad") {
        by("notice").hidden = false;
        by("notice").textContent = text;
        shown = [];
        writeRate();
        isAnswered = false;
    } else if (!isAnswered) {
        isAnswered = true;
        showNotice();
    }
}

function listen() {
    const redraw = () => {
        image.draw();
        space?.redraw();
    };
    by("image-labels").addEventListener("change", ({ target }) => { image.labels = target.checked; redraw(); });
    by("pipeline").addEventListener("change", ({ target }) => wish({ do: "pipeline", name: target.value }));
    by("depth-topic").addEventListener("change", ({ target }) => wish({ do: "depth_topic", name: target.value }));
    if (!space) {
        return;
    }
    by("space-labels").addEventListener("change", ({ target }) => { space.labels = target.checked; redraw(); });
    by("space-points").addEventListener("change", ({ target }) => { space.points = target.checked; });
    by("halo").addEventListener("change", ({ target }) => { space.halo = Number(target.value); redraw(); });
    by("views").addEventListener("click", ({ target }) => { if (target.dataset.view) { space.look(target.dataset.view); } });
    by("frames").addEventListener("click", ({ target }) => {
        if (target.dataset.frame) {
            space.coordinates = target.dataset.frame;
            by("frames").querySelectorAll("button").forEach((button) => button.classList.toggle("on", button === target));
            redraw();
            space.look("free");
        }
    });
}

function drawScale() {
    const context = by("scale-bar").getContext("2d");
    const data = context.createImageData(256, 1);
    data.data.set(SCALE);
    context.putImageData(data, 0, 0);
}

drawScale();
listen();
// The user chooses the resolution of the image; its default is the same for a phone and a screen.
follow({
    wanted: () => by("detail").value,
    show: (answer) => {
        about = answer.about ?? about;
        const isOver = !answer.player && !about.run && about.notice !== null && !about.pipelines.includes(about.title);
        timeline.show(answer.player, about.run, isOver);
        showState("good");
        if (answer.about) {
            showAbout(Boolean(answer.player));
        }
        if (answer.frame) {
            showFrame(answer.frame);
        } else {
            writeRate();
        }
        showAge(!isOver && (answer.frame || !isOld));
    },
    tell,
    rest: () => (space === null || space.isSlow ? SLOW_MS : 0),
});
