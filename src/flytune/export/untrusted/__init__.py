"""Readers of files from untrusted sources; each file is inspected before any part of it is run."""
