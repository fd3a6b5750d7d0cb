"""Export a policy to ONNX and run it with onnxruntime alone, as another program would.

Needs `pip install "flytune[onnx]"`.

python examples/export_to_onnx.py
python examples/export_to_onnx.py --observations 10   for a first look
"""

import argparse
from pathlib import Path

import numpy as np
import onnxruntime

import flytune

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--observations", type=int, default=1000, help="observations to compare on")
options = parser.parse_args()

policy = flytune.find_controller("baseline-refined").controller
flytune.save_onnx(Path("policy.onnx"), policy)

# from here on nothing of flytune is needed, except to compare
session = onnxruntime.InferenceSession("policy.onnx", providers=["CPUExecutionProvider"])
observations = np.random.default_rng(0).normal(size=(options.observations, 17)).astype(np.float32)
(actions,) = session.run(["action"], {"observation": observations})
print(f"actions: {actions.shape}, in [{actions.min():.2f}, {actions.max():.2f}]")

difference = np.abs(actions - np.asarray(policy(observations))).max()
print(f"largest difference to flytune's own policy: {difference:.1e}")
print("metadata:", ", ".join(sorted(session.get_modelmeta().custom_metadata_map)))
