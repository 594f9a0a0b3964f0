"""What rasterio reads of a survey's GeoTIFF. usage: survey_tif.py OUT TIF -> OUT/survey.json"""

import json
import sys
from pathlib import Path

import numpy as np
import rasterio

out, tif = Path(sys.argv[1]), sys.argv[2]
with rasterio.open(tif) as file:
    bands = file.read()
    said = {
        "epsg": file.crs.to_epsg(),
        "transform": list(file.transform)[:6],
        "size": [file.width, file.height],
        "types": list(file.dtypes),
        "names": list(file.descriptions),
        "nodata_is_nan": bool(np.isnan(file.nodata)),
        "area": file.tags().get("AREA_OR_POINT"),
        "bands": [[None if np.isnan(v) else float(v) for v in band.ravel()] for band in bands],
    }
(out / "survey.json").write_text(json.dumps(said))
