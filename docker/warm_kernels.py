"""Compile all kernels next to their sources when the image is built, so that its first start does not.

Also imports every module, so that the build fails if the image lacks a part that they need. Libraries of extras are no
such part.
"""

import importlib
import os
import pkgutil
import threading

os.environ.pop("NUMBA_CACHE_DIR", None)

import roughmap
import roughmap_client
import roughmap_ros
import roughmap_schemas
import roughmap_service
from roughmap_schemas import Config
from roughmap_service.engine.warmup import warm_up

EXTRAS = {"laspy", "rasterio"}

for package in (roughmap, roughmap_schemas, roughmap_client, roughmap_ros, roughmap_service):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            if error.name not in EXTRAS:
                raise

for model in ("point", "cuboid", "ellipsoid"):
    config = {"map": {"error_model": model}, "sensors": {"lidar": {"range_sigma": 0.02}}}
    warm_up(Config.model_validate(config), threading.Event())
