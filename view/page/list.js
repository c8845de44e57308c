// The list of objects or tracks: position, size, confidence and velocity.

import { element, swatch } from "./elements.js";
import { degrees, difference, foundBy, isSecond, millimetres, name, norm, percent } from "./words.js";

/** A cell of the table, as text with a smaller text behind it. */
function cell(label, text, sigma) {
    const cell = element("td", {}, text);
    if (text !== "") {
        cell.dataset.label = label;
    }
    if (sigma) {
        cell.append(element("span", { className: "sigma" }, ` ± ${sigma}`));
    }
    return cell;
}

const chip = (text, kind = "") => element("span", { className: `chip ${kind}` }, text);

/** The name of an item; `other` is the result of a second variant for it. */
const named = (item, other) => [swatch(item), ...(other ? [swatch(other)] : []), name(item)];

/** Short remarks about the state of a track, and about the variants that found the item. */
function chips(item, other) {
    const made = [];
    if (item.state && item.state !== "confirmed") {
        made.push(chip(item.state === "coasting" ? `coasting, unseen for ${item.misses}` : item.state, item.state));
    }
    if (item.variant) {
        const isOther = other && other.kind !== item.kind;
        made.push(chip(isOther ? `B: ${other.kind}` : foundBy(item), isOther || !other ? "differs" : ""));
    }
    return made;
}

function confidence(item) {
    const made = cell("sure", item.confidence === undefined ? "" : percent(item.confidence));
    if (item.confidence !== undefined) {
        const colour = item.confidence > 0.9 ? "good" : item.confidence > 0.6 ? "warn" : "bad";
        const style = `width: ${100 * item.confidence}%; background: var(--${colour})`;
        made.append(element("span", { className: "meter" }, element("i", { style })));
    }
    return made;
}

/** The cells of a row after the name. */
function cells(item) {
    const [x, y, z] = item.center.map((part) => part.toFixed(3));
    const away = Math.max(...item.sigma.center) * 1000;
    // For a cone, the radius at its centre, to which the standard deviation belongs.
    const [mm, sigma] = millimetres(item.radius_at_center, item.sigma.radius).split(" ± ");
    const angle = item.half_angle === undefined ? "" : `, ${degrees(item.half_angle)}`;
    const base = item.kind === "cone" ? [cell("base radius", millimetres(item.base_radius))] : [];
    const speed = item.velocity ? `${norm(item.velocity).toFixed(2)} m/s` : "";
    return [
        confidence(item),
        cell("at", `${x}, ${y}, ${z} m`, `${away.toFixed(away < 1.95 ? 1 : 0)} mm`),
        cell("radius", mm, sigma),
        ...base,
        cell("length", item.length === undefined ? "" : `${millimetres(item.length)}${angle}`),
        item.variant
            ? cell("B", item.difference ? difference(item.difference) : "")
            : cell("speed", speed, item.velocity ? norm(item.sigma.velocity).toFixed(2) : ""),
    ];
}

/** The tooltip of a row. */
function title(item) {
    const ends = item.kind === "cone" ? `radius ${millimetres(item.top_radius)} to ${millimetres(item.base_radius)}; ` : "";
    return `${ends}${item.points} points in ${item.rows} scan lines, ${(item.rms * 1000).toFixed(1)} mm from the surface`;
}

/** A row of the table. It is reused for the same track, with its button, which would otherwise lose the keyboard focus. */
class Row {
    element;
    #name;
    #chips = element("span");

    /** `choose` is called when the row is clicked or pressed; without it the row cannot be selected. */
    constructor(choose) {
        this.#name = element(choose ? "button" : "span");
        this.element = element("tr", {}, element("td", {}, this.#name, this.#chips));
        if (choose) {
            this.element.addEventListener("click", choose);
        }
    }

    show(item, other, isChosen) {
        this.#name.replaceChildren(...named(item, other));
        this.#chips.replaceChildren(...chips(item, other));
        if (this.#name.matches("button")) {
            this.#name.setAttribute("aria-pressed", String(isChosen));
        }
        [...this.element.cells].slice(1).forEach((cell) => cell.remove());
        this.element.append(...cells(item));
        this.element.title = title(item);
        this.element.classList.toggle("on", isChosen);
    }
}

const HEADS = ["what", "confidence", "x, y, z from the camera", "radius", "length", "speed"];
/** The last heading if two variants are compared. */
const COMPARED = "B from A";

export class ListView {
    #head = element("thead", {}, element("tr", {}, ...HEADS.map((text) => element("th", { scope: "col" }, text))));
    #body = element("tbody");
    #none = element("td", { className: "none", colSpan: HEADS.length });
    #rows = new Map();
    #choose;

    /** `choose` is called with the number of the track that was clicked or pressed. */
    constructor(table, choose) {
        this.#choose = choose;
        table.append(this.#head, this.#body);
    }

    show({ kind, items, compared }, chosen) {
        this.#head.querySelector("th:last-child").textContent = compared ? COMPARED : HEADS.at(-1);
        const rows = new Map();
        items.filter((item) => !isSecond(item)).forEach((item, index) => {
            const key = item.id === undefined ? `object ${index}` : item.id;
            const row = this.#rows.get(key) ?? new Row(item.id === undefined ? null : () => this.#choose(item.id));
            row.show(item, items[item.pair], item.id !== undefined && item.id === chosen);
            rows.set(key, row);
        });
        this.#rows = rows;
        this.#head.hidden = items.length === 0;
        if (rows.size === 0) {
            this.#none.textContent = kind ? "nothing found in this frame" : "nobody has looked for anything in this frame";
            this.#body.replaceChildren(element("tr", {}, this.#none));
            return;
        }
        this.#place([...rows.values()].map((row) => row.element));
    }

    /** Puts rows in order; those already in place stay, and keep the keyboard focus. */
    #place(wanted) {
        [...this.#body.rows].filter((row) => !wanted.includes(row)).forEach((row) => row.remove());
        wanted.forEach((row, index) => {
            if (this.#body.rows[index] !== row) {
                this.#body.insertBefore(row, this.#body.rows[index] ?? null);
            }
        });
    }
}
