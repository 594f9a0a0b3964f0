"""Plays a recorded flight to a running nightfix over Zenoh: each row's prior, then its frame."""

import json
import time

import zenoh

from flight import Flight, Row
from services import Daemon, DemoError, Subscriber
from subscriber import session_config

START_TIMEOUT_S = 60.0
ANSWER_TIMEOUT_S = 20.0


class Player:
    """A Zenoh session that publishes priors and frames."""

    def __init__(self, endpoint: str, vehicle: str):
        self._session = zenoh.open(session_config(endpoint))
        root = f"nightfix/v1/{vehicle}"
        self._alive_key = f"{root}/alive"
        self._priors = self._session.declare_publisher(f"{root}/prior", congestion_control=zenoh.CongestionControl.BLOCK)
        self._frames = self._session.declare_publisher(f"{root}/frame", congestion_control=zenoh.CongestionControl.BLOCK)

    def wait_for(self, daemon: Daemon) -> None:
        """Waits until the daemon's liveliness token is seen and it subscribes to priors and frames."""
        deadline = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < deadline:
            daemon.require_running()
            tokens = [reply.ok for reply in self._session.liveliness().get(self._alive_key) if reply.ok]
            if tokens and self._priors.matching_status.matching and self._frames.matching_status.matching:
                return
            time.sleep(0.1)
        raise DemoError(f"no liveliness token on {self._alive_key} within {START_TIMEOUT_S:.0f} s")

    def send(self, row: Row, hfov_deg: float | None) -> None:
        """The row's prior, if it has one, then its frame."""
        if (prior := row.prior()) is not None:
            self._priors.put(json.dumps(prior), encoding=zenoh.Encoding.APPLICATION_JSON)
        self._frames.put(row.path.read_bytes(), attachment=json.dumps(row.attachment(hfov_deg)))

    def close(self) -> None:
        """Closes the session."""
        self._session.close()


def play(flight: Flight, player: Player, subscriber: Subscriber, daemon: Daemon, progress) -> list[dict]:
    """Plays every row and waits for its answer in the subscriber; the answers, in order."""
    answers = []
    for row in flight.rows:
        player.send(row, flight.hfov_deg)
        answer = subscriber.next(ANSWER_TIMEOUT_S)
        daemon.require_running()
        if answer is None:
            raise DemoError(f"no answer to {row.path.name} within {ANSWER_TIMEOUT_S:.0f} s")
        if answer["stamp_ns"] != row.stamp_ns:
            raise DemoError(f"{row.path.name}: the answer is for stamp {answer['stamp_ns']}, expected {row.stamp_ns}")
        answers.append(answer)
        progress(len(answers), len(flight.rows))
    return answers
