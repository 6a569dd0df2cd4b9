"""The laws once more in float64, straight from the papers' equations: what the fixed-point laws are
measured against. One file a paper."""

from tools.verify.reference import Reference
from tools.verify.references import afilc, cailc, drac, iplc, mtcc

REFERENCES: dict[str, Reference] = {
    **cailc.REFERENCES,
    **drac.REFERENCES,
    **mtcc.REFERENCES,
    **afilc.REFERENCES,
    **iplc.REFERENCES,
}
