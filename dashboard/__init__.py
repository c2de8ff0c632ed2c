"""Live page in a browser on this machine that shows the work of sampler and learner.

All data come over zenoh, so the page is a separate process, next to the others or elsewhere. It needs the extra `view`;
no other package imports it.
"""
