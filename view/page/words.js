// Formats numbers with units and standard deviations, as short as possible.

/** A length in metres. */
export const metres = (value, places = 2) => `${value.toFixed(places)} m`;

/** A length in metres as millimetres, with digits according to its standard deviation: "98.2 ± 0.4 mm". */
export function millimetres(value, sigma) {
    const mm = value * 1000;
    if (!(sigma > 0)) {
        return `${mm.toFixed(mm < 100 ? 1 : 0)} mm`;
    }
    const places = sigma * 1000 < 1.95 ? 1 : 0;
    return `${mm.toFixed(places)} ± ${(sigma * 1000).toFixed(places)} mm`;
}

/** An angle in radians as degrees. */
export function degrees(value, sigma) {
    const deg = (value * 180) / Math.PI;
    const of = sigma > 0 ? ` ± ${((sigma * 180) / Math.PI).toFixed(1)}` : "";
    return `${deg.toFixed(1)}${of}°`;
}

/** A probability in percent. */
export const percent = (value) => `${Math.round(value * 100)} %`;

/** A time in milliseconds; a dash if it is unknown. */
export const milliseconds = (value) => (value === null || value === undefined ? "–" : `${value.toFixed(value < 10 ? 2 : 1)} ms`);

/** A count in groups of three digits. */
export const count = (value) => value.toLocaleString("en-US").replaceAll(",", "\u202f");

/** Length of a vector. */
export const norm = (vector) => Math.hypot(...vector);

/** The name of an item: its number if it has one, and its kind. */
export const name = (item) => (item.id === undefined ? item.kind : `#${item.id} ${item.kind}`);

/** The size of an item in one line. */
export function size(item) {
    if (item.kind === "cone") {
        return `base r ${millimetres(item.base_radius)}, ${degrees(item.half_angle, item.sigma.half_angle)}`;
    }
    return `r ${millimetres(item.radius, item.sigma.radius)}`;
}

/** How certain an item is, from 0 to 1: its confidence, reduced if it was not seen. */
export function sureness(item) {
    const confidence = item.confidence ?? 0.8;
    const seen = { tentative: 0.55, coasting: 0.6 }[item.state] ?? 1;
    return confidence * seen;
}

/** Whether this is the second variant's result for an item that is shown with the first one's. */
export const isSecond = (item) => item.variant === "b" && item.pair !== undefined;

/** Which variant found it; empty if none are compared. */
export function foundBy(item) {
    const letter = item.variant?.toUpperCase();
    return !letter ? "" : item.pair === undefined ? `only ${letter}` : "A and B";
}

/** The difference of B's result from A's, in millimetres. */
export function difference({ position_m: position, radius_m: radius }) {
    const mm = (metres) => (metres * 1000).toFixed(1);
    return `${mm(position)} mm away, radius ${radius < 0 ? "−" : "+"}${mm(Math.abs(radius))} mm`;
}
