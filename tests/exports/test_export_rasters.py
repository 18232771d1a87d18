"""Rasters, read back by other libraries than those that wrote them, and compared cell by cell."""

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import rasterio
import tifffile
import yaml
from click.testing import CliRunner
from exported_map import LAYERS, SIDE, Stored
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from PIL import Image

from roughmap_service.cli.export import export as command


def test_a_geotiff_has_the_layers_their_units_and_their_place(stored: Stored, export) -> None:
    file = export("ground.tif", "--crs", "EPSG:32633")
    with tifffile.TiffFile(file) as tiff:
        page = tiff.pages[0]
        values, tags, said = page.asarray(), page.geotiff_tags, page.tags["GDAL_METADATA"].value
        no_data = page.tags["GDAL_NODATA"].value
    for number, name in enumerate(LAYERS):
        assert np.array_equal(values[::-1, :, number], stored.layers[name], equal_nan=True), name
        assert f'sample="{number}" role="description">{name}<' in said
    assert 'role="unittype">rad<' in said
    assert no_data == "nan"
    assert tags["ProjectedCSTypeGeoKey"] == 32633
    assert tags["ModelPixelScale"][:2] == [SIDE, SIDE]
    top = stored.low[1] + SIDE * len(stored.layers["slope"])
    assert tags["ModelTiepoint"] == [0, 0, 0, stored.low[0], top, 0]


def test_a_geotiff_is_cloud_optimised(export) -> None:
    with rasterio.open(export("ground.tif")) as opened:
        assert opened.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"


def test_qgis_finds_a_style_for_the_first_layer(stored: Stored, export) -> None:
    style = ET.parse(export("ground.tif").with_suffix(".qml")).getroot()
    renderer = style.find("pipe/rasterrenderer")
    assert renderer is not None
    heights = stored.layers["mean_height"]
    assert renderer.get("band") == "1"
    assert np.float32(renderer.get("classificationMin")) == np.nanmin(heights)
    values = [float(item.get("value")) for item in renderer.iter("item")]
    assert values == sorted(values)
    assert np.float32(values[-1]) == np.nanmax(heights)


def test_an_npz_has_the_arrays(stored: Stored, export) -> None:
    with np.load(export("ground.npz")) as arrays:
        for name in LAYERS:
            assert np.array_equal(arrays[name], stored.layers[name], equal_nan=True)
        assert tuple(arrays["origin"]) == stored.low
        assert arrays["cell_size"] == SIDE


def test_an_ascii_grid_is_read_by_gdal(stored: Stored, export) -> None:
    with rasterio.open(export("ground.asc", "--layers", "max_height")) as opened:
        values, masked = opened.read(1), opened.read_masks(1)
        assert opened.bounds[:2] == stored.low
        assert opened.res == (SIDE, SIDE)
    known = np.isfinite(stored.layers["max_height"])
    assert np.array_equal(masked[::-1] > 0, known)
    assert np.array_equal(values[::-1][known], stored.layers["max_height"][known])


def test_a_picture_is_where_its_world_file_says(stored: Stored, export) -> None:
    file = export("ground.png", "--layers", "traversability")
    with Image.open(file) as image:
        shown = np.asarray(image.convert("RGBA"))[::-1]
        shades = np.asarray(image)[::-1]
    values = stored.layers["traversability"]
    known = np.isfinite(values)
    assert np.array_equal(shown[:, :, 3] > 0, known)
    assert np.array_equal(shades[known], np.round(values[known].astype(float) * 254).astype(np.uint8))
    with rasterio.open(file) as opened:  # GDAL reads the world file
        assert opened.bounds[:2] == pytest.approx(stored.low, abs=1e-9)  # corner to centre and back rounds
        assert opened.res == (SIDE, SIDE)


def test_a_map_for_nav2_is_as_map_server_reads_it(stored: Stored, export) -> None:
    file = export("ground.yaml", "--threshold", "0.4")
    said = yaml.safe_load(file.read_text())
    with Image.open(file.with_name(said["image"])) as image:
        shade = np.asarray(image).astype(float)
    # map_server: occupancy is (255 - shade) / 255, the first row is the highest y, origin the lower left corner.
    assert said["negate"] == 0
    assert said["mode"] == "trinary"
    occupancy = (255 - shade[::-1]) / 255
    cells = np.where(occupancy > said["occupied_thresh"], 100, np.where(occupancy < said["free_thresh"], 0, -1))
    values = stored.layers["traversability"]
    expected = np.where(np.isnan(values), -1, np.where(values >= np.float32(0.4), 0, 100))
    assert np.array_equal(cells, expected)
    assert set(np.unique(cells)) == {-1, 0, 100}
    assert said["resolution"] == SIDE
    assert said["origin"] == [*stored.low, 0.0]


def test_a_bag_has_the_map_as_a_grid_map(stored: Stored, export) -> None:
    folder = export("ground")
    (file,) = folder.glob("*.mcap")
    with file.open("rb") as opened:
        ((_, channel, _, grid),) = make_reader(opened, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
    rows, columns = stored.layers["slope"].shape
    assert channel.topic == "/grid_map"
    assert (grid.header.frame_id, grid.header.stamp.sec) == ("map", 1_700_000_000)
    assert list(grid.layers) == list(LAYERS)
    assert list(grid.basic_layers) == ["mean_height"]
    assert (grid.info.length_x, grid.info.length_y, grid.info.resolution) == (columns * SIDE, rows * SIDE, SIDE)
    centre = np.array([grid.info.pose.position.x, grid.info.pose.position.y])
    for name, data in zip(grid.layers, grid.data, strict=True):
        # Column-major; grid_map's position of an index: centre + (length - resolution) / 2 - resolution * index.
        matrix = np.array(data.data, np.float32).reshape((columns, rows), order="F")
        places = centre + (np.array([columns, rows]) - 1) * SIDE / 2 - SIDE * np.array([3, 5])
        i, j = np.floor((places - stored.low) / SIDE).astype(int)
        assert np.array_equal(matrix[3, 5], stored.layers[name][j, i], equal_nan=True)
        assert np.array_equal(matrix[::-1, ::-1].T, stored.layers[name], equal_nan=True)


def test_a_bag_replaces_a_bag_and_no_other_folder(stored: Stored, export, tmp_path: Path) -> None:
    folder = export("ground")
    assert export("ground", "--force") == folder
    (folder / "metadata.yaml").unlink()
    done = CliRunner().invoke(command, [str(stored.path), "-o", str(folder), "--force"])
    assert "not a bag" in done.output
    assert list(folder.glob("*.mcap"))
