"""A page to look at: what sampler and learner do, live in a browser on this machine.

Everything comes over zenoh, so this is a process of its own, beside the others or elsewhere. Needs the extra `view`;
nothing else imports this package.
"""

from __future__ import annotations
