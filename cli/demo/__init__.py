"""The demo: a simulated scene, the two real processes, a querying client, an evaluation and a view."""
