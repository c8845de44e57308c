// The list of what was found: where it is, how big, how sure, and how it moves.

import { colourOf, css } from "./colours.js";
import { degrees, difference, foundBy, isSecond, millimetres, name, norm, percent } from "./words.js";

/** A cell of the table, as text with a smaller text behind it. */
function cell(label, text, sigma) {
    const cell = document.createElement("td");
    cell.dataset.label = label;
    cell.textContent = text;
    if (text === "") {
        delete cell.dataset.label;
    }
    if (sigma) {
        const small = document.createElement("span");
        small.className = "sigma";
        small.textContent = ` ± ${sigma}`;
        cell.append(small);
    }
    return cell;
}

function swatch(item) {
    const swatch = document.createElement("i");
    swatch.className = "swatch";
    swatch.style.background = css(colourOf(item));
    return swatch;
}

function chip(text, kind = "") {
    return Object.assign(document.createElement("span"), { className: `chip ${kind}`, textContent: text });
}

/** What it is; `other` is the same as a second variant has found it. */
function first(item, other) {
    const cell = document.createElement("td");
    cell.append(swatch(item), ...(other ? [swatch(other)] : []), name(item));
    if (item.state && item.state !== "confirmed") {
        cell.append(chip(item.state === "coasting" ? `coasting, unseen for ${item.misses}` : item.state, item.state));
    }
    if (item.variant) {
        const isOther = other && other.kind !== item.kind;
        cell.append(chip(isOther ? `B: ${other.kind}` : foundBy(item), isOther || !other ? "differs" : ""));
    }
    return cell;
}

function confidence(item) {
    const made = cell("sure", item.confidence === undefined ? "" : percent(item.confidence));
    if (item.confidence !== undefined) {
        const [meter, bar] = [document.createElement("span"), document.createElement("i")];
        meter.className = "meter";
        bar.style.width = percent(item.confidence).replace(" ", "");
        bar.style.background = item.confidence > 0.9 ? "var(--good)" : item.confidence > 0.6 ? "var(--warn)" : "var(--bad)";
        meter.append(bar);
        made.append(meter);
    }
    return made;
}

function row(item, other, isChosen) {
    const row = document.createElement("tr");
    const [x, y, z] = item.center.map((part) => part.toFixed(3));
    const away = Math.max(...item.sigma.center) * 1000;
    const radius = item.kind === "cone" ? item.base_radius : item.radius;
    const [mm, sigma] = millimetres(radius, item.sigma.radius).split(" ± ");
    const angle = item.half_angle === undefined ? "" : `, ${degrees(item.half_angle)}`;
    const speed = item.velocity ? `${norm(item.velocity).toFixed(2)} m/s` : "";
    row.append(
        first(item, other),
        confidence(item),
        cell("at", `${x}, ${y}, ${z} m`, `${away.toFixed(away < 1.95 ? 1 : 0)} mm`),
        cell(item.kind === "cone" ? "base radius" : "radius", mm, sigma),
        cell("length", item.length === undefined ? "" : `${millimetres(item.length)}${angle}`),
        item.variant
            ? cell("B", item.difference ? difference(item.difference) : "")
            : cell("speed", speed, item.velocity ? norm(item.sigma.velocity).toFixed(2) : ""),
    );
    row.title = `${item.points} points in ${item.rows} scan lines, ${(item.rms * 1000).toFixed(1)} mm from the surface`;
    row.classList.toggle("on", isChosen);
    return row;
}

const HEADS = ["", "confidence", "x, y, z from the camera", "radius", "length", "speed"];
/** The last of them where two variants are compared. */
const COMPARED = "B from A";

export class ListView {
    #table;
    #head = document.createElement("thead");
    #body = document.createElement("tbody");
    #choose;

    /** `choose` is told the number of the track that was clicked. */
    constructor(table, choose) {
        [this.#table, this.#choose] = [table, choose];
        const row = document.createElement("tr");
        row.append(...HEADS.map((text) => Object.assign(document.createElement("th"), { textContent: text })));
        this.#head.append(row);
        this.#table.append(this.#head, this.#body);
    }

    show({ kind, items, compared }, chosen) {
        this.#head.querySelector("th:last-child").textContent = compared ? COMPARED : HEADS.at(-1);
        const rows = items.filter((item) => !isSecond(item)).map((item) => {
            const made = row(item, items[item.pair], item.id !== undefined && item.id === chosen);
            made.addEventListener("click", () => this.#choose(item.id));
            return made;
        });
        if (rows.length === 0) {
            const none = Object.assign(document.createElement("td"), { className: "none", colSpan: HEADS.length });
            none.textContent = kind ? "nothing found in this frame" : "nobody has looked for anything in this frame";
            rows.push(document.createElement("tr"));
            rows[0].append(none);
        }
        this.#head.hidden = items.length === 0;
        this.#body.replaceChildren(...rows);
    }
}
