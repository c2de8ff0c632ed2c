"""The store of pairs: a SQLite file with checksums, migrations and retention."""
