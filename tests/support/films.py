"""What several tests share of capture frames."""

import subprocess

import imageio_ffmpeg

SIZE = (96, 64)
TICKS = 90_000


def ffmpeg(*options, content=None):
    """Run ffmpeg; ``content`` is what it reads of the file ``-``."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", "-nostdin", *map(str, options)]
    subprocess.run(command, input=content, check=True)


def film(path, ticks, *options):
    """A video whose frame k is a uniform grey of 10 + 5 k, shown at ``ticks[k]`` / 90000 s."""
    width, height = SIZE
    # an expression of the frame's number: the sum of its steps up to it
    steps = "+".join(f"gte(N\\,{k})*{b - a}" for k, (a, b) in enumerate(zip(ticks, ticks[1:]), start=1))
    pictures = f"nullsrc=s={width}x{height}:r=30,geq=lum='10+5*N':cb=128:cr=128"
    ffmpeg(
        *("-f", "lavfi", "-i", pictures, "-frames:v", len(ticks)),
        *("-vf", f"settb=1/{TICKS},setpts='{ticks[0]}+{steps}',setparams=range=pc,format=yuvj420p"),
        *("-fps_mode", "passthrough", "-enc_time_base", f"1:{TICKS}", "-video_track_timescale", TICKS),
        *("-c:v", "libx264", "-crf", "8", *options, path),
    )
    return path
