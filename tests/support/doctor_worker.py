"""Replace the process that checks a device with a script."""

from clsplat.conformance import supervision

SCRIPT = """
import json, os, sys
print("noise of a runtime", file=sys.stderr)
for name in sys.argv[4:]:
    if name == "dies":
        os.abort()
    if %s and "PYOPENCL_NO_CACHE" not in os.environ:
        print(json.dumps({"fault": "x.cl does not build", "log": "", "out_of_memory": False}))
        print(json.dumps({"end": name, "seconds": 0.1}), flush=True)
        continue
    if name == "leaves":
        sys.exit(3)
    deviation = {"kernel": "blend_backward", "label": "x", "value": %s, "bound": 0.1, "counts": False}
    print(json.dumps({"deviation": deviation}))
    print(json.dumps({"end": name, "seconds": 0.1}), flush=True)
"""


def worker(monkeypatch, value: str = "1e-6", damaged: str = 'name == "cached"') -> None:
    """Replace the process that opens the device by a script; `damaged`: for which checks empty caches help."""
    monkeypatch.setattr(supervision, "WORKER", ("-c", SCRIPT % (damaged, value)))
