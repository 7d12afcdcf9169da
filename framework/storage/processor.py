"""Number formats that the processor of this machine computes fast."""

import torch


def fast_bfloat16(device: torch.device) -> bool:
    """Return whether the device multiplies matrices of bfloat16 faster than of float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
