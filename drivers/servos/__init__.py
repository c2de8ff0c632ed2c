"""What is common to all makes of servos on a bus: questions and answers, the handshake, and the joints as a source."""

from __future__ import annotations
