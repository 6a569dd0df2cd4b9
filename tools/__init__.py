"""The command line, the runners, tracing and reports."""
