"""The laws once more in float64, straight from the papers' equations: what the fixed-point laws are
measured against. One file a paper."""

from ato_hil.tools.papers.afilc import reference as afilc
from ato_hil.tools.papers.cailc import reference as cailc
from ato_hil.tools.papers.drac import reference as drac
from ato_hil.tools.papers.iplc import reference as iplc
from ato_hil.tools.papers.mtcc import reference as mtcc
from ato_hil.tools.papers.reference import Reference

REFERENCES: dict[str, Reference] = {
    **cailc.REFERENCES,
    **drac.REFERENCES,
    **mtcc.REFERENCES,
    **afilc.REFERENCES,
    **iplc.REFERENCES,
}
