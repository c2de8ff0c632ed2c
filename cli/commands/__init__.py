"""One module per command; each imports what it needs when it runs, so that `bodyschema --help` stays fast."""
