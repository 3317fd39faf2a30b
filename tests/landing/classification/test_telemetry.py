"""Nothing is written to the user's home directory, or sent anywhere, by ONNX Runtime."""

import os
import subprocess
import sys
from pathlib import Path


def test_onnx_runtime_keeps_no_record_of_its_use(tmp_path: Path) -> None:
    code = (
        "from touchdown.landing.classification.engine import OnnxClassifier\n"
        "from touchdown.landing.classification.onboard import SHIPPED\n"
        "OnnxClassifier(SHIPPED)"
    )
    environment = {name: value for name, value in os.environ.items() if not name.startswith("ORT_")}
    environment |= {"HOME": str(tmp_path), "XDG_CACHE_HOME": ""}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
