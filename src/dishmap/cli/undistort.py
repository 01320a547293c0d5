"""`dishmap undistort`: a photograph as a camera without lens distortion would have taken it, the paper's T(im)."""

from __future__ import annotations

from pathlib import Path

import click

from dishmap.cli.options import PATH, POSITIVE, camera_option, out_file, refuse_overwriting
from dishmap.cli.terminal import say


@click.command("undistort")
@click.argument("photo", type=PATH)
@camera_option
@click.option("--zoom", type=POSITIVE, default=1.0, show_default=True, help="Below 1 brings in what a barrel lens has in its corners.")
@click.option("--camera-out", type=PATH, help="Also write the camera file of the new picture.")
@out_file("Picture (.png, .tif, .bmp, .jpg or .webp)")
def undistort_command(photo: Path, camera_file: Path, zoom: float, camera_out: Path | None, out: Path) -> None:
    """Take the lens out of a photograph, for people to look at: a measurement does not need it."""
    from dishmap.camera.undistort import pinhole_camera, undistort_image
    from dishmap.io.atomic import output_folder
    from dishmap.io.camera_file import read_camera, write_camera
    from dishmap.io.images import read_gray
    from dishmap.io.picture_file import check_picture_name, write_picture

    check_picture_name(out)
    for given in (out, camera_out):
        if given is not None:
            refuse_overwriting(given, [photo, camera_file])
    camera = read_camera(camera_file)
    with output_folder(out.parent):
        picture, pinhole = undistort_image(camera, read_gray(photo), pinhole_camera(camera, zoom))
        write_picture(out, picture)
    if camera_out is not None:
        with output_folder(camera_out.parent):
            write_camera(camera_out, pinhole)
    say(f"{out}: {picture.shape[1]}x{picture.shape[0]} px, focal length {pinhole.focal_px[0]:.6g} px, no distortion")
