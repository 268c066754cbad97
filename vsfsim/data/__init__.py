"""The dataset on disk: one schema for writer, reader, verifier and docs."""
