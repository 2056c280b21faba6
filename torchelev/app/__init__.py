"""The command line, the demo, and the reports that they write. Nothing in the library imports it."""
