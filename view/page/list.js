// The list of what was found: where it is, how big, how sure, and how it moves.

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

/** What it is; `other` is the same as a second variant has found it. */
function first(item, other) {
    const cell = element("td", {}, swatch(item), ...(other ? [swatch(other)] : []), name(item));
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
        const colour = item.confidence > 0.9 ? "good" : item.confidence > 0.6 ? "warn" : "bad";
        const style = `width: ${100 * item.confidence}%; background: var(--${colour})`;
        made.append(element("span", { className: "meter" }, element("i", { style })));
    }
    return made;
}

function row(item, other, isChosen) {
    const [x, y, z] = item.center.map((part) => part.toFixed(3));
    const away = Math.max(...item.sigma.center) * 1000;
    const radius = item.kind === "cone" ? item.base_radius : item.radius;
    const [mm, sigma] = millimetres(radius, item.sigma.radius).split(" ± ");
    const angle = item.half_angle === undefined ? "" : `, ${degrees(item.half_angle)}`;
    const speed = item.velocity ? `${norm(item.velocity).toFixed(2)} m/s` : "";
    const title = `${item.points} points in ${item.rows} scan lines, ${(item.rms * 1000).toFixed(1)} mm from the surface`;
    const row = element(
        "tr",
        { title },
        first(item, other),
        confidence(item),
        cell("at", `${x}, ${y}, ${z} m`, `${away.toFixed(away < 1.95 ? 1 : 0)} mm`),
        cell(item.kind === "cone" ? "base radius" : "radius", mm, sigma),
        cell("length", item.length === undefined ? "" : `${millimetres(item.length)}${angle}`),
        item.variant
            ? cell("B", item.difference ? difference(item.difference) : "")
            : cell("speed", speed, item.velocity ? norm(item.sigma.velocity).toFixed(2) : ""),
    );
    row.classList.toggle("on", isChosen);
    return row;
}

const HEADS = ["", "confidence", "x, y, z from the camera", "radius", "length", "speed"];
/** The last of them where two variants are compared. */
const COMPARED = "B from A";

export class ListView {
    #head = element("thead", {}, element("tr", {}, ...HEADS.map((text) => element("th", {}, text))));
    #body = element("tbody");
    #choose;

    /** `choose` is told the number of the track that was clicked. */
    constructor(table, choose) {
        this.#choose = choose;
        table.append(this.#head, this.#body);
    }

    show({ kind, items, compared }, chosen) {
        this.#head.querySelector("th:last-child").textContent = compared ? COMPARED : HEADS.at(-1);
        const rows = items.filter((item) => !isSecond(item)).map((item) => {
            const made = row(item, items[item.pair], item.id !== undefined && item.id === chosen);
            made.addEventListener("click", () => this.#choose(item.id));
            return made;
        });
        if (rows.length === 0) {
            const none = kind ? "nothing found in this frame" : "nobody has looked for anything in this frame";
            rows.push(element("tr", {}, element("td", { className: "none", colSpan: HEADS.length }, none)));
        }
        this.#head.hidden = items.length === 0;
        this.#body.replaceChildren(...rows);
    }
}
