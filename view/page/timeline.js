// The timeline: play, pause and step for a recording or a run; for a recording also position and speed.

import { wish } from "./server.js";

const PLAY = "M4 2.5v11l9-5.5z";
const PAUSE = "M3.5 3h3v10h-3zM9.5 3h3v10h-3z";

/** Elements with their own use of keys: selections and sliders use the arrows, and these and buttons use space. */
const OWN_ARROWS = 'select, input:not([type="checkbox"])';
const OWN_SPACE = "select, input, button";

/** Whether the arrow keys scroll an element sideways. */
const scrolls = ({ tabIndex, scrollWidth, clientWidth }) => tabIndex >= 0 && scrollWidth > clientWidth;

/** Describes whether a run is paused. */
function told({ can_pause: canPause, live, paused }) {
    const names = live.join(", ");
    if (!canPause) {
        return `${names}: live, and cannot be paused`;
    }
    const others = live.length > 0 ? `; ${names}: live, and goes on` : "";
    return `${paused ? "the run is paused" : "the run goes on"}${others}`;
}

export class Timeline {
    #parts;
    #player;
    #run;
    #waits = false;
    #isHeld = false;
    #hasStepped = false;

    constructor(footer) {
        const part = (id) => footer.querySelector(`#${id}`);
        this.#parts = {
            footer, at: part("at"), length: part("length"), play: part("play"), forward: part("forward"), position: part("position"),
            speed: part("speed"), note: part("pause-note"), ofRecordings: [part("back"), part("at"), part("length"), part("position"), part("speed")],
        };
        part("back").addEventListener("click", () => wish({ do: "step", by: -1 }));
        part("forward").addEventListener("click", () => wish({ do: "step", by: 1 }));
        this.#parts.play.addEventListener("click", () => this.#toggle());
        this.#parts.speed.addEventListener("change", ({ target }) => wish({ do: "speed", factor: Number(target.value) }));
        const { position } = this.#parts;
        position.addEventListener("input", () => {
            this.#isHeld = true;
            wish({ do: "seek", at_s: (Number(position.value) / 1000) * this.#player.length_s });
        });
        position.addEventListener("change", () => { this.#isHeld = false; });
        document.addEventListener("keydown", (event) => this.#key(event));
        // A control used with a pointer gives up the focus; keyboard users keep it.
        document.addEventListener("click", ({ detail }) => {
            const { activeElement } = document;
            if (detail > 0 && activeElement?.matches("button, input")) {
                activeElement.blur();
            }
        });
    }

    /** Shows the state of the recording or of the run; `waits` says that there is neither. */
    show(player, run, waits) {
        [this.#player, this.#run, this.#waits] = [player, player ? null : run, waits];
        this.#hasStepped = false;
        const { footer, at, length, play, position, speed } = this.#parts;
        footer.hidden = !player && !run?.can_pause && !run?.live.length;
        this.#parts.ofRecordings.forEach((part) => { part.hidden = !player; });
        this.#showState(play);
        if (!player) {
            return;
        }
        at.textContent = `${player.at_s.toFixed(2)} s`;
        length.textContent = `${player.length_s.toFixed(2)} s`;
        if (!this.#isHeld) {
            position.value = String(Math.round((1000 * player.at_s) / Math.max(player.length_s, 1e-9)));
        }
        if (document.activeElement !== speed) {
            speed.value = String(player.speed);
        }
    }

    #showState(play) {
        play.querySelector("path").setAttribute("d", this.goesOn ? PAUSE : PLAY);
        play.setAttribute("aria-label", this.goesOn ? "Pause" : "Play");
        const { note, forward } = this.#parts;
        [play.disabled, forward.disabled] = [!this.#canPause, !this.#canPause];
        note.hidden = Boolean(this.#player);
        note.textContent = this.#run ? told(this.#run) : "";
    }

    /** The state: "recording", "waiting", "paused" or "live". */
    get state() {
        return this.#player ? "recording" : this.#waits ? "waiting" : this.#run?.paused ? "paused" : "live";
    }

    /** Whether more frames are expected. */
    get goesOn() {
        return this.#player ? this.#player.plays : !this.#waits && !this.#run?.paused;
    }

    get #canPause() {
        return Boolean(this.#player || this.#run?.can_pause);
    }

    #toggle() {
        wish({ do: this.goesOn ? "pause" : "play" });
    }

    #key(event) {
        const { key, target, repeat } = event;
        const step = (by) => wish({ do: "step", by });
        const keys = { " ": () => this.#toggle(), ArrowLeft: () => step(-1), ArrowRight: () => step(1) };
        // With these modifiers the keys belong to the browser, such as for going back.
        const isBrowsers = event.altKey || event.ctrlKey || event.metaKey;
        const isOwn = target.matches?.(key === " " ? OWN_SPACE : OWN_ARROWS) || (key !== " " && scrolls(target));
        if (!this.#canPause || !keys[key] || isBrowsers || isOwn) {
            return;
        }
        event.preventDefault();
        // A held arrow key repeats steps as fast as they are shown; a held space key acts once.
        if (!repeat || (key !== " " && !this.#hasStepped)) {
            this.#hasStepped = true;
            keys[key]();
        }
    }
}
