"""Fields (Mip-NeRF, optionally with a hash grid): a network instead of Gaussians, with the same interface."""
