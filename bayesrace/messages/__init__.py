"""Messages between processes.

``types`` has the message classes, ``table`` the topics and services, ``codec`` turns messages into
bytes, and into JSON for logs, and refuses everything else, ``datagram`` puts topic and message
together for links to a controller without Python, ``link`` has what only these carry, ``seal`` puts
them under a key, ``serial_frames`` into frames of a serial line, ``numbering`` counts losses. What
their ``__all__`` name is public.
"""

from bayesrace.messages.codec import *  # noqa: F403
from bayesrace.messages.datagram import *  # noqa: F403
from bayesrace.messages.link import *  # noqa: F403
from bayesrace.messages.numbering import *  # noqa: F403
from bayesrace.messages.seal import *  # noqa: F403
from bayesrace.messages.serial_frames import *  # noqa: F403
from bayesrace.messages.table import *  # noqa: F403
from bayesrace.messages.types import *  # noqa: F403
