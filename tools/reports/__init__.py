"""Pages for people: the HTML report of a run, the load and timing of a bus."""
