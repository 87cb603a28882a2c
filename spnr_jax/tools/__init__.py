"""What the commands do with a trained network: pictures, depth maps, meshes, exports, the page of `spnr view`."""
