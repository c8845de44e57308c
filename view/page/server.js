// Asks the server for what has not been seen yet, again and again; and tells it what is wished.

const browser = Array.from(crypto.getRandomValues(new Uint8Array(8)), (byte) => byte.toString(16).padStart(2, "0")).join("");
const AGAIN_MS = 1500;
/** Who draws a frame in less is fast: two pictures of a screen. */
const SLOW_MS = 34;

const sleep = (ms) => new Promise((done) => setTimeout(done, ms));

/** Waits until the page is to be seen: a hidden one asks for nothing. */
function visible() {
    if (!document.hidden) {
        return Promise.resolve();
    }
    return new Promise((done) => document.addEventListener("visibilitychange", done, { once: true }));
}

/** Takes an answer apart: the length of a text, the text, the depths of the pixels. */
function read(buffer) {
    const length = new DataView(buffer).getUint32(0, true);
    const answer = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
    const image = answer.frame?.image;
    if (image) {
        answer.frame.pixels = new Uint16Array(buffer, 4 + length, image.columns * image.rows);
    }
    // Two variants count their tracks each for itself.
    for (const item of answer.frame?.items ?? []) {
        if (item.variant && item.id !== undefined) {
            item.id = `${item.variant}${item.id}`;
        }
    }
    return answer;
}

/**
 * Asks for ever; `wanted` tells how many pixels along a row, `show` draws an answer, `tell` says how it goes, `rest` how many
 * milliseconds there are between two questions at least.
 */
export async function follow({ wanted, show, tell, rest }) {
    // The numbers of the last frame, and of what was told last around the frames.
    let seen = { frames: 0, told: 0 };
    for (;;) {
        await visible();
        let answer;
        try {
            const query = new URLSearchParams({ browser, ...seen, columns: wanted() });
            const response = await fetch(`look?${query}`);
            if (!response.ok) {
                tell("bad", (await response.text()).trim());
                await sleep(AGAIN_MS);
                continue;
            }
            answer = read(await response.arrayBuffer());
        } catch {
            // Nobody is there, or the answer was cut.
            seen = { frames: 0, told: 0 };
            tell("bad", "conicflow view does not answer: has it ended? It is asked again.");
            await sleep(AGAIN_MS);
            continue;
        }
        seen = { frames: answer.frames, told: answer.told };
        await new Promise(requestAnimationFrame);
        const begin = performance.now();
        try {
            show(answer);
            tell("good", "");
        } catch (error) {
            // The next one may be drawn.
            reportError(error);
            tell("bad", `This page cannot draw what it got; it may help to load it anew (${error.message}).`);
        }
        // The next one comes when this one is drawn. Who takes long for it rests as long: it may be on the robot.
        await new Promise(requestAnimationFrame);
        const took = performance.now() - begin;
        await sleep(Math.max(took > SLOW_MS ? took : 0, rest() - took));
    }
}

/** Comes when all wishes before are sent. */
let sent = Promise.resolve();

/** Tells a wish, such as { do: "pause" }, when those before it are told: sent at once, they might come in another order. */
export function wish(command) {
    const body = JSON.stringify(command);
    const send = () => fetch("command", { method: "POST", headers: { "Content-Type": "application/json" }, body });
    sent = sent.then(send).catch(() => {
        // Whether the server is there is told by the asking.
    });
}
