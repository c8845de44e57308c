// Parts of the page, made by code.

import { colourOf, css } from "./colours.js";

/** An element with these properties, and what is in it. */
export function element(tag, properties, ...children) {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...children);
    return made;
}

/** A spot in the colour of an item. */
export const swatch = (item) => element("i", { className: "swatch", style: `background: ${css(colourOf(item))}` });
