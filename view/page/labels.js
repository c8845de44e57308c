// Labels beside items: they never overlap each other, and cover items as little as possible.

import { colourOf, css } from "./colours.js";
import { foundBy, isSecond, name, percent, size, sureness } from "./words.js";

const FONT = '12px system-ui, "Segoe UI", Roboto, "Noto Sans", "DejaVu Sans", sans-serif';
const LINE = 15;
const PAD = 5;
/** In a narrower drawing, labels have one line. */
const NARROW = 460;

/** The font of a line: the first line is the name. */
const font = (index) => `${index === 0 ? 600 : 400} ${FONT}`;

/** The lines of an item's label. */
export function lines(item) {
    const state = item.state && item.state !== "confirmed" ? ` ${item.state}` : "";
    const sure = item.confidence === undefined ? "" : `  ${percent(item.confidence)}`;
    const variants = foundBy(item);
    return [`${variants ? `${variants}: ` : ""}${name(item)}${state}${sure}`, size(item)];
}

const overlaps = (a, b) => a.x < b.x + b.width && b.x < a.x + a.width && a.y < b.y + b.height && b.y < a.y + a.height;

const rectangle = ({ left, top, right, bottom }) => ({ x: left, y: top, width: right - left, height: bottom - top });

/** Possible positions of a label of this size around a box, the best first. */
function places({ left, top, right, bottom }, width, height) {
    const middle = (left + right - width) / 2;
    const beside = (top + bottom - height) / 2;
    const above = [0, -0.3, 0.3, -0.55, 0.55].map((shift) => [middle + shift * width, top - height - 6]);
    const around = [
        ...above, [right + 6, beside], [left - width - 6, beside], [middle, bottom + 6],
        [right + 6, top - height], [left - width - 6, top - height], [right + 6, bottom], [left - width - 6, bottom],
    ];
    const farther = [];
    for (let away = 1; away <= 6; away += 1) {
        const shift = away * (height + 4);
        farther.push([middle, top - height - 6 - shift], [right + 6, beside - shift], [right + 6, beside + shift]);
        farther.push([left - width - 6, beside - shift], [left - width - 6, beside + shift], [middle, bottom + 6 + shift]);
    }
    return [...around, ...farther];
}

/**
 * Draws the labels of `named`, a list of { item, box }, into a drawing of this size in CSS pixels; the chosen one is placed
 * first.
 */
export function drawLabels(context, named, width, height, chosen) {
    const taken = [];
    const order = named.filter(({ item }) => !isSecond(item)).sort((a, b) => (b.item.id === chosen) - (a.item.id === chosen) || sureness(b.item) - sureness(a.item));
    for (const { item, box } of order) {
        const texts = lines(item).slice(0, width < NARROW ? 1 : 2);
        const widths = texts.map((text, index) => {
            context.font = font(index);
            return context.measureText(text).width;
        });
        const size = { width: Math.max(...widths) + 2 * PAD + 4, height: texts.length * LINE + PAD };
        const clamp = ([x, y]) => ({
            x: Math.min(Math.max(x, 2), width - size.width - 2), y: Math.min(Math.max(y, 2), height - size.height - 2), ...size,
        });
        const free = places(box, size.width, size.height).map(clamp).filter((at) => !taken.some((other) => overlaps(at, other)));
        const others = named.filter((other) => other.item !== item).map((other) => rectangle(other.box));
        const place = free.find((at) => !others.some((other) => overlaps(at, other))) ?? free[0];
        if (place) {
            taken.push(place);
            drawLabel(context, item, texts, place, box);
        }
    }
}

function drawLabel(context, item, texts, { x, y, width, height }, box) {
    const colour = colourOf(item);
    const sure = 0.5 + 0.5 * sureness(item);
    const [toX, toY] = [Math.min(Math.max(x + width / 2, box.left), box.right), Math.min(Math.max(y + height / 2, box.top), box.bottom)];
    const [fromX, fromY] = [Math.min(Math.max(toX, x), x + width), Math.min(Math.max(toY, y), y + height)];
    if (Math.hypot(toX - fromX, toY - fromY) > 14) {
        context.strokeStyle = css(colour, 0.7 * sure);
        context.lineWidth = 1;
        context.beginPath();
        context.moveTo(fromX, fromY);
        context.lineTo(toX, toY);
        context.stroke();
    }
    context.fillStyle = "rgb(9 12 18 / 0.78)";
    context.beginPath();
    context.roundRect(x, y, width, height, 4);
    context.fill();
    context.fillStyle = css(colour, sure);
    context.fillRect(x, y + 3, 3, height - 6);
    texts.forEach((text, index) => {
        context.font = font(index);
        context.fillStyle = index === 0 ? css(colour, sure) : `rgb(228 233 242 / ${sure})`;
        context.fillText(text, x + PAD + 4, y + LINE * (index + 1) - 2);
    });
}
