// The time line: play, pause and step a recording or a run; of a recording also go somewhere else, faster or slower.

import { wish } from "./server.js";

const PLAY = "M4 2.5v11l9-5.5z";
const PAUSE = "M3.5 3h3v10h-3zM9.5 3h3v10h-3z";

/** Whether a run is paused, in words. */
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
    #isHeld = false;

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
    }

    /** Shows where the recording is, or whether the run is paused, if there is one. */
    show(player, run) {
        [this.#player, this.#run] = [player, player ? null : run];
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
        play.querySelector("path").setAttribute("d", this.#goesOn ? PAUSE : PLAY);
        play.setAttribute("aria-label", this.#goesOn ? "Pause" : "Play");
        const { note, forward } = this.#parts;
        [play.disabled, forward.disabled] = [!this.#canPause, !this.#canPause];
        note.hidden = Boolean(this.#player);
        note.textContent = this.#run ? told(this.#run) : "";
    }

    /** What is shown: "recording", "paused" or "live". */
    get state() {
        return this.#player ? "recording" : this.#run?.paused ? "paused" : "live";
    }

    get #goesOn() {
        return this.#player ? this.#player.plays : !this.#run?.paused;
    }

    get #canPause() {
        return Boolean(this.#player || this.#run?.can_pause);
    }

    #toggle() {
        wish({ do: this.#goesOn ? "pause" : "play" });
    }

    #key(event) {
        const isTyped = ["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName) && event.target.type !== "checkbox";
        const keys = { " ": () => this.#toggle(), ArrowLeft: () => wish({ do: "step", by: -1 }), ArrowRight: () => wish({ do: "step", by: 1 }) };
        if (this.#canPause && keys[event.key] && !isTyped) {
            event.preventDefault();
            keys[event.key]();
        }
    }
}
