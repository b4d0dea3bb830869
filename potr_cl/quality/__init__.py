"""How good pictures are: PSNR and SSIM, on the host and on a device, of scenes against scenes and photographs."""
