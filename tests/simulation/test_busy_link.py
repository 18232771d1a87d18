"""What the simulation publishes arrives, as fast as it may be sent."""

import threading

import zenoh
from net import Gathered, open_pair

from roughmap_service.simulation.publishing import RoverPublisher
from roughmap_service.simulation.rover import Message

CLOUDS = 200
BYTES = 300_000


def test_a_slow_reader_makes_the_publisher_wait_and_loses_nothing() -> None:
    """60 MB at once to one that takes a while for each message: by Zenoh's default most would be dropped."""
    taken: Gathered[int] = Gathered()
    pause = threading.Event()

    def take(sample: zenoh.Sample) -> None:
        pause.wait(0.005)
        attachment = sample.attachment
        assert attachment is not None
        taken(int.from_bytes(attachment.to_bytes(), "little"))

    with open_pair() as (reader, writer):
        subscriber = reader.declare_subscriber("robots/*/points", zenoh.handlers.Callback(take, indirect=False))
        with RoverPublisher(writer, ["rover1"]) as publisher:
            # The reader does not listen to poses, so this waits for its subscription alone.
            heard = threading.Event()
            clouds = writer.declare_publisher("robots/rover1/points")
            clouds.declare_matching_listener(lambda status: heard.set() if status.matching else None)
            assert getattr(clouds.matching_status, "matching", clouds.matching_status) or heard.wait(30.0)
            messages = (Message(k, "points", bytes(BYTES), "rover1", k) for k in range(CLOUDS))
            assert publisher.play(messages, rate=0).clouds == CLOUDS
            assert taken.wait(lambda numbers: len(numbers) == CLOUDS, "all clouds") == [*range(CLOUDS)]
        subscriber.undeclare()
