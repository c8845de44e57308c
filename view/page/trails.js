// Where tracks have been: their centres of the last seconds, in the camera's frame of coordinates and, where its pose is known,
// in the world's.

const LENGTH_S = 4;
const MOST_POINTS = 240;

/** A point of the camera's frame in the world, by `pose`, row-major [R | t]. */
export const toWorld = (pose, [x, y, z]) => pose.map(([a, b, c, t]) => a * x + b * y + c * z + t);

export class Trails {
    #trails = new Map();
    #epoch;
    #stamp = 0;

    /** Takes a frame; what comes from another run, or from before, begins anew. */
    follow({ epoch, stamp_s: stamp, pose, items }) {
        if (epoch !== this.#epoch || stamp < this.#stamp || stamp > this.#stamp + LENGTH_S) {
            this.#trails.clear();
        }
        [this.#epoch, this.#stamp] = [epoch, stamp];
        for (const item of items.filter(({ id }) => id !== undefined)) {
            if (!this.#trails.has(item.id)) {
                this.#trails.set(item.id, []);
            }
            const world = pose ? toWorld(pose, item.center) : null;
            this.#trails.get(item.id).push({ stamp, camera: item.center, world });
        }
        for (const [id, trail] of this.#trails) {
            while (trail.length > MOST_POINTS || (trail.length > 0 && trail[0].stamp < stamp - LENGTH_S)) {
                trail.shift();
            }
            if (trail.length === 0) {
                this.#trails.delete(id);
            }
        }
    }

    /** The points of a track, the oldest first; `frame` is "camera" or "world". */
    of(id, frame) {
        return (this.#trails.get(id) ?? []).map((point) => point[frame]).filter((point) => point);
    }
}
