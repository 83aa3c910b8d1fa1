"""Record how late small messages are that share a slow uplink with uploads: a trace to train and
fly with.

    sudo python examples/queue_trace.py --seconds 1200       (in real time; Linux with iproute2)
    damian train "delay.obs={law: trace, path: queue_trace.csv}" aware=timeline

Three network namespaces stand for a UAV, its modem and a server, with virtual cables between them.
The modem sends at 512 kbit/s (``tc tbf``) from one queue, first in, first out, of 480,000 bytes:
when it is full, it is 7.5 s long, and what comes is lost. The UAV sends a message every second by
UDP, and uploads pictures by the kernel's TCP (Reno), the next one after 20 s in the mean, also
while others are on their way. No delay is drawn or computed: packets wait in the kernel's queue, and
both ends read one clock. Delays are rounded to tenths of a second, as a busy machine measures no
better.
"""

import argparse
import os
import random
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

RATE, QUEUE = "512kbit", 480_000
"""Rate of the uplink, and length of its queue [bytes]."""
MESSAGE, PICTURE, PAUSE = 100, (200_000, 1_500_000), 20.0
"""Sizes of a message and of the smallest and largest picture [bytes]; mean time between two uploads
[s]."""
SERVER = "10.62.2.2"
PORT = 6262
ROOMS = uav, modem, server = [f"{name}{os.getpid()}" for name in ("uav", "modem", "server")]
ENDS = {
    "wire0": (uav, "10.62.1.1"),
    "wire1": (modem, "10.62.1.2"),
    "radio0": (modem, "10.62.2.1"),
    "radio1": (server, SERVER),
}
NETWORK = [
    *(f"ip netns add {room}" for room in ROOMS),
    f"ip link add wire0 netns {uav} type veth peer name wire1 netns {modem}",
    f"ip link add radio0 netns {modem} type veth peer name radio1 netns {server}",
    *(f"ip -n {room} address add {address}/24 dev {end}" for end, (room, address) in ENDS.items()),
    *(f"ip -n {room} link set {end} up" for end, (room, _) in ENDS.items()),
    f"ip -n {uav} route add default via 10.62.1.2",
    f"ip -n {server} route add default via 10.62.2.1",
    f"ip netns exec {modem} sysctl -qw net.ipv4.ip_forward=1",
    f"tc -n {modem} qdisc add dev radio0 root tbf rate {RATE} burst 3000 limit {QUEUE}",
]


def send(seconds: int) -> None:
    """Be the UAV: send a numbered message every second, and upload pictures meanwhile."""
    threading.Thread(target=upload_pictures, daemon=True).start()
    sender = socket.socket(type=socket.SOCK_DGRAM)
    began = time.monotonic()
    for number in range(seconds):
        time.sleep(max(began + number - time.monotonic(), 0))
        sender.sendto(struct.pack("Id", number, time.monotonic()).ljust(MESSAGE), (SERVER, PORT))


def upload_pictures() -> None:
    """Begin an upload after each pause, whose length is exponential."""
    draw = random.Random(0)
    while True:
        time.sleep(draw.expovariate(1 / PAUSE))
        threading.Thread(target=upload, args=[draw.randint(*PICTURE)], daemon=True).start()


def upload(size: int) -> None:
    """Send a picture, at the rate that TCP finds."""
    with socket.create_connection((SERVER, PORT)) as sender:
        sender.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, b"reno")
        sender.sendall(bytes(size))


def receive(seconds: int) -> None:
    """Be the server: print the number and the delay [s] of each message that arrives."""
    threading.Thread(target=take_pictures, daemon=True).start()
    receiver = socket.socket(type=socket.SOCK_DGRAM)
    ends = time.monotonic() + seconds + 20
    receiver.bind((SERVER, PORT))
    while (left := ends - time.monotonic()) > 0:
        receiver.settimeout(left)
        try:
            message = receiver.recv(MESSAGE)
        except TimeoutError:
            break
        number, sent = struct.unpack_from("Id", message)
        print(number, time.monotonic() - sent, flush=True)


def take_pictures() -> None:
    """Receive all pictures, and throw them away."""
    with socket.create_server((SERVER, PORT)) as waiting:
        while True:
            threading.Thread(target=take, args=[waiting.accept()[0]], daemon=True).start()


def take(picture: socket.socket) -> None:
    with picture:
        while picture.recv(2**16):
            pass


def record(seconds: int, file: Path) -> None:
    """Build the network, let both ends run, and write the delay of each message in the order of
    sending."""
    role = [sys.executable, __file__, "--seconds", str(seconds), "--role"]
    try:
        for words in NETWORK:
            subprocess.run(words.split(), check=True)
        exec_ = ["ip", "netns", "exec"]
        with subprocess.Popen(
            [*exec_, server, *role, "server"], stdout=subprocess.PIPE, text=True
        ) as ears:
            time.sleep(1)
            subprocess.run([*exec_, uav, *role, "uav"], check=True)
            arrived = dict(line.split() for line in ears.communicate()[0].splitlines())
    finally:
        for room in ROOMS:
            subprocess.run(["ip", "netns", "delete", room], check=False)
    rows = [
        f"{float(arrived[str(n)]):.1f}s" if str(n) in arrived else "lost" for n in range(seconds)
    ]
    file.write_text("\n".join(["delay", *rows, ""]), encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seconds", type=int, default=1200, help="length of the trace")
    parser.add_argument("--out", type=Path, default=Path("queue_trace.csv"))
    parser.add_argument("--role", choices=["uav", "server"], help=argparse.SUPPRESS)
    words = parser.parse_args()
    if words.role:
        (send if words.role == "uav" else receive)(words.seconds)
    else:
        record(words.seconds, words.out)
