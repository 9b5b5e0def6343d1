"""Own photographs and videos: frames, lenses, the printed board, camera poses, metres and the floor."""
