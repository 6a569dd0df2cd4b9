"""Everything around a run, in rooms. A room imports from rooms above it in this list alone:

1. `runs`: what a run is and what it leaves
2. `trace`: what is seen of it
3. `session`: how runs are made
4. `campaigns`, `papers`, `export`: many runs for one question; each paper's claims, figures,
   reference; the firmware as C; `lines`: lines and trains of others become scenarios
5. `verify`, `reports`, `bench`: evidence, pages, rates
6. `cli`: the command line
"""
