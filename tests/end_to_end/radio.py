#!/usr/bin/env python3
"""A radio between two network namespaces: radio.py FIRST SECOND MBIT/S DELAY_MS LOSS_PERCENT

Makes a network device `cable` in each namespace and carries IP packets between them, in both directions alike: one after
the other at the rate, each so much later, some lost by a fixed random sequence. A packet that would wait for more than
MAX_WAIT_S in the sender's queue is dropped, as radios do. Prints a line when the devices are there.
"""

import fcntl
import heapq
import os
import random
import select
import struct
import subprocess
import sys
import time

TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
MAX_WAIT_S = 0.1


class Way:
    """One direction: what is under way, in the order of arrival."""

    def __init__(self, source, target, rate, delay, loss, seed):
        self.source, self.target, self.rate, self.delay, self.loss = source, target, rate, delay, loss
        self.random, self.idle_from, self.under_way = random.Random(seed), 0.0, []

    def take(self, now):
        packet = os.read(self.source, 65536)
        self.idle_from = max(self.idle_from, now)
        if self.idle_from - now > MAX_WAIT_S:
            return
        self.idle_from += len(packet) * 8 / self.rate
        if self.random.random() >= self.loss:
            heapq.heappush(self.under_way, (self.idle_from + self.delay, packet))

    def deliver(self, now):
        while self.under_way and self.under_way[0][0] <= now:
            try:
                os.write(self.target, heapq.heappop(self.under_way)[1])
            except OSError:
                pass  # the device is down, as after a pulled cable


def device(namespace, name):
    tun = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tun, TUNSETIFF, struct.pack("16sH22x", name.encode(), IFF_TUN | IFF_NO_PI))
    subprocess.run(["ip", "link", "set", name, "netns", namespace, "name", "cable"], check=True)
    return tun


def main(first, second, rate, delay, loss):
    ends = [device(first, f"cfa{os.getpid()}"), device(second, f"cfb{os.getpid()}")]
    rates = float(rate) * 1e6, float(delay) * 1e-3, float(loss) * 1e-2
    ways = [Way(*ends, *rates, seed=1), Way(*reversed(ends), *rates, seed=2)]
    print("ready", flush=True)
    while True:
        now = time.monotonic()
        for way in ways:
            way.deliver(now)
        arrivals = [way.under_way[0][0] for way in ways if way.under_way]
        timeout = max(0.0, min(arrivals) - now) if arrivals else None
        readable, _, _ = select.select(ends, [], [], timeout)
        for way in ways:
            if way.source in readable:
                try:
                    way.take(time.monotonic())
                except OSError:
                    pass  # nothing there after all, or the device is down


if __name__ == "__main__":
    if len(sys.argv) != 6:
        sys.exit(__doc__)
    main(*sys.argv[1:])
