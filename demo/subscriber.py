"""An independent subscriber: prints every fix message that the daemon publishes, one JSON line each.

It shares no code with nightfix: only Zenoh, the key and the message. Run it beside any nightfix:

    python demo/subscriber.py --connect tcp/127.0.0.1:7447 --vehicle uav

The first line is `{"subscribed": true}`, once a message of the daemon has come in: from then on no fix is missed.
"""

import argparse
import json
import sys

import zenoh


def session_config(endpoint: str) -> zenoh.Config:
    """A peer that connects to one endpoint, listens nowhere and scouts nobody."""
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    return config


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--connect", required=True, help="where nightfix listens, for example tcp/127.0.0.1:7447")
    parser.add_argument("--vehicle", default="uav", help="the vehicle's name in its keys")
    arguments = parser.parse_args()

    def emit(line: str) -> None:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()

    root = f"nightfix/v1/{arguments.vehicle}"
    with zenoh.open(session_config(arguments.connect)) as session:
        fixes = session.declare_subscriber(f"{root}/fix")
        # The status comes once a second and is subscribed to after the fixes: once it arrives, both are in place.
        status = session.declare_subscriber(f"{root}/status")
        status.recv()
        status.undeclare()
        emit('{"subscribed": true}')
        for sample in fixes:
            emit(json.dumps(json.loads(sample.payload.to_bytes())))


if __name__ == "__main__":
    try:
        main()
    except (KeyboardInterrupt, BrokenPipeError):
        sys.exit(0)
