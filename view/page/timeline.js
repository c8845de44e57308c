// The time line of a recording: play, pause, step, go somewhere else, faster or slower.

import { wish } from "./server.js";

const PLAY = "M4 2.5v11l9-5.5z";
const PAUSE = "M3.5 3h3v10h-3zM9.5 3h3v10h-3z";

export class Timeline {
    #parts;
    #player;
    #isHeld = false;

    constructor(footer) {
        const part = (id) => footer.querySelector(`#${id}`);
        this.#parts = { footer, at: part("at"), length: part("length"), play: part("play"), position: part("position"), speed: part("speed") };
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

    /** Shows where the recording is; a run has no time line. */
    show(player) {
        this.#player = player;
        const { footer, at, length, play, position, speed } = this.#parts;
        footer.hidden = !player;
        if (!player) {
            return;
        }
        at.textContent = `${player.at_s.toFixed(2)} s`;
        length.textContent = `${player.length_s.toFixed(2)} s`;
        play.querySelector("path").setAttribute("d", player.plays ? PAUSE : PLAY);
        play.setAttribute("aria-label", player.plays ? "Pause" : "Play");
        if (!this.#isHeld) {
            position.value = String(Math.round((1000 * player.at_s) / Math.max(player.length_s, 1e-9)));
        }
        if (document.activeElement !== speed) {
            speed.value = String(player.speed);
        }
    }

    /** Whether there is one. */
    get isShown() {
        return Boolean(this.#player);
    }

    #toggle() {
        wish({ do: this.#player?.plays ? "pause" : "play" });
    }

    #key(event) {
        const isTyped = ["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName) && event.target.type !== "checkbox";
        const keys = { " ": () => this.#toggle(), ArrowLeft: () => wish({ do: "step", by: -1 }), ArrowRight: () => wish({ do: "step", by: 1 }) };
        if (this.#player && keys[event.key] && !isTyped) {
            event.preventDefault();
            keys[event.key]();
        }
    }
}
