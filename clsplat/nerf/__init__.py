"""Fields (Mip-NeRF and its grid): a network instead of Gaussians, behind the protocol that training knows."""
