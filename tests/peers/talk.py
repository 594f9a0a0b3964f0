"""A Zenoh peer that is not ours: what a test tells it goes out, what it hears comes back.

usage: talk.py ENDPOINT VEHICLE  (it listens on ENDPOINT)
One JSON object per line. In: {"do": "put", "key": "prior", "payload": {...} | "text"},
{"do": "frame", "attachment": {...} | "text" | null, "file": PATH | "bytes": N}, {"do": "get"}. Out: {"event": "ready"},
{"event": "sample", ...}, {"event": "alive", "kind": ...}, {"event": "replies", "replies": [...]}.
"""

import json
import sys
import threading
from pathlib import Path

import zenoh

lock = threading.Lock()


def say(**event: object) -> None:
    with lock:
        print(json.dumps(event), flush=True)


def decoded(sample: zenoh.Sample) -> dict:
    text = sample.payload.to_string()
    return {"key": str(sample.key_expr), "encoding": str(sample.encoding), "message": json.loads(text) if text else None}


def encoded(value: object) -> str | None:
    return value if value is None or isinstance(value, str) else json.dumps(value)


def main() -> None:
    endpoint, vehicle = sys.argv[1:]
    root = f"nightfix/v1/{vehicle}"
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    with zenoh.open(config) as session:
        # As whoever sends frames should: by default Zenoh drops what does not fit its queue.
        block = zenoh.CongestionControl.BLOCK
        publishers = {
            key: session.declare_publisher(f"{root}/{key}", congestion_control=block) for key in ("frame", "prior", "attitude")
        }
        subscribers = [
            session.declare_subscriber(f"{root}/{key}", lambda sample: say(event="sample", **decoded(sample)))
            for key in ("fix", "status")
        ]
        subscribers.append(
            session.liveliness().declare_subscriber(
                f"{root}/alive", lambda sample: say(event="alive", kind=str(sample.kind).rsplit(".", 1)[-1]), history=True
            )
        )
        say(event="ready")
        for line in sys.stdin:
            order = json.loads(line)
            if order["do"] == "put":
                publishers[order["key"]].put(encoded(order["payload"]))
            elif order["do"] == "frame":
                payload = Path(order["file"]).read_bytes() if "file" in order else bytes(order["bytes"])
                publishers["frame"].put(payload, attachment=encoded(order["attachment"]))
            elif order["do"] == "get":
                replies = [decoded(reply.ok) for reply in session.get(f"{root}/fix") if reply.ok]
                say(event="replies", replies=replies)


if __name__ == "__main__":
    main()
