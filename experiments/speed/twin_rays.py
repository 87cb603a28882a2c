"""The half of the PyTorch twin (speed/twin.py) that draws: sizes, trilinear lookup, field, samples along rays."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

BLOCK = 8192  # samples whose products stay in the cache


@dataclass(frozen=True, kw_only=True)
class Config:
    """Sizes, losses and learning rates; those of the preset `abo` where nothing else is said."""

    points: int = 1024
    point_widths: tuple[int, ...] = (64, 128, 256)
    point_features: int = 32
    grid: int = 64
    base: int = 16
    stages: int = 5
    groups: int = 8
    field_hidden: int = 64
    features: int = 32
    dir_freqs: int = 4
    render: int = 64
    coarse: int = 64
    fine: int = 64
    pdf_pad: float = 1e-5
    up_width: int = 64
    disc_width: int = 64
    l1_weight: float = 100.0
    lowres_weight: float = 0.5
    adv_weight: float = 1.0
    r1_gamma: float = 10.0
    r1_every: int = 0  # 0: no R1
    lr_g: float = 2e-4
    lr_d: float = 2e-4

    @property
    def image(self) -> int:
        """Pixels along a side of the picture."""
        return 2 * self.render


class LerpRows(torch.autograd.Function):
    """sum_k w[p, k] rows[idx[p, k]]; its gradient by the rows goes block by block."""

    @staticmethod
    def forward(ctx, rows: Tensor, idx: Tensor, w: Tensor) -> Tensor:
        """The sums (p, features)."""
        ctx.save_for_backward(idx, w)
        ctx.count = len(rows)
        return F.embedding_bag(idx, rows, per_sample_weights=w, mode="sum")

    @staticmethod
    def backward(ctx, *grads: Tensor):
        """The transposed map."""
        (grad,), (idx, w) = grads, ctx.saved_tensors
        out = grad.new_zeros(ctx.count, grad.shape[1])
        for s in range(0, len(idx), BLOCK):
            piece = slice(s, s + BLOCK)
            products = grad[piece, None] * w[piece, :, None]
            out.index_add_(0, idx[piece].reshape(-1), products.flatten(0, 1))
        return out, None, None


def lookup(volume: Tensor, positions: Tensor, fast: bool) -> Tensor:
    """Trilinear lookup (batch, rays, samples, features) inside the box, clamped to the outermost centres."""
    if not fast:
        out = F.grid_sample(volume, positions[:, None], padding_mode="border", align_corners=False)
        return out[:, :, 0].permute(0, 2, 3, 1)
    batch, features, n = volume.shape[:3]
    grid = ((positions + 1) * (0.5 * n) - 0.5).clamp(0, n - 1).flatten(1, 2)
    low = grid.floor().clamp(max=n - 2)
    part = torch.stack([1 - (grid - low), grid - low])  # (2, batch, p, 3)
    x, y, z = low.long().unbind(-1)
    first = ((torch.arange(batch)[:, None] * n + z) * n + y) * n + x
    corners = [(k, j, i) for k in (0, 1) for j in (0, 1) for i in (0, 1)]
    idx = first[..., None] + torch.tensor([(k * n + j) * n + i for k, j, i in corners])
    w = torch.stack([part[k, ..., 2] * part[j, ..., 1] * part[i, ..., 0] for k, j, i in corners], -1)
    rows = volume.permute(0, 2, 3, 4, 1).reshape(-1, features)
    return LerpRows.apply(rows, idx.view(-1, 8), w.view(-1, 8)).view(*positions.shape[:3], features)


class Field(nn.Module):
    """Density softplus(raw - 1), rgb and other features of samples."""

    def __init__(self, c: Config, fast: bool):
        super().__init__()
        self.fast, self.freqs = fast, c.dir_freqs
        self.hidden = nn.Linear(c.base, c.field_hidden)
        self.density = nn.Linear(c.field_hidden, 1)
        self.feature = nn.Linear(c.field_hidden + 3 + 6 * c.dir_freqs, c.features)

    def view(self, d: Tensor) -> Tensor:
        """The part of the features that the direction decides, once a ray."""
        waves = [wave(d * 2**k) for k in range(self.freqs) for wave in (torch.sin, torch.cos)]
        weight = self.feature.weight[:, self.hidden.out_features :]
        return F.linear(torch.cat([d, *waves], -1), weight, self.feature.bias)

    def samples(self, x: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
        """Density, and what is composited: rgb and features, or rgb and the hidden layer that they are linear in."""
        h = F.softplus(self.hidden(x))
        weight = self.feature.weight[: 3 if self.fast else None, : self.hidden.out_features]
        out = F.linear(h, torch.cat([self.density.weight, weight]))
        rgb = torch.sigmoid(out[..., 1:4] + view[:, :, None, :3])
        rest = h if self.fast else out[..., 4:] + view[:, :, None, 3:]
        return F.softplus(out[..., 0] + self.density.bias - 1), torch.cat([rgb, rest], -1)

    def finish(self, total: Tensor, acc: Tensor, view: Tensor) -> Tensor:
        """Composited features (batch, rays, features), rgb on white."""
        rest = total[..., 3:]
        if self.fast:
            rest = F.linear(rest, self.feature.weight[3:, : self.hidden.out_features]) + acc * view[..., 3:]
        return torch.cat([total[..., :3] + 1 - acc, rest], -1)


def camera_rays(c2w: Tensor, focal: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Origins and unit directions (batch, size * size, 3), row by row."""
    x = ((torch.arange(size) + 0.5) * (2 / size) - 1) / focal[:, None]
    right, up, back, eye = c2w[:, None, None].unbind(-1)
    d = x[:, None, :, None] * right - x[:, :, None, None] * up - back
    return eye.flatten(1, 2).expand(-1, size * size, -1), F.normalize(d.flatten(1, 2), dim=-1)


def ray_box(o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Entry and exit distance of the box [-1, 1]^3, (batch, rays, 1); both 0 for a miss."""
    inverse = 1 / torch.where(d.abs() < 1e-9, 1e-9, d)
    a, b = (-1 - o) * inverse, (1 - o) * inverse
    near, far = torch.minimum(a, b).amax(-1, True).clamp_min(0), torch.maximum(a, b).amin(-1, True)
    return torch.where(far > near, near, 0), torch.where(far > near, far, 0)


def weights_of(density: Tensor, t: Tensor, far: Tensor) -> Tensor:
    """Weights of sorted samples; one owns the stretch up to the next."""
    tau = density * torch.diff(t, append=far)
    return torch.exp(tau - torch.cumsum(tau, -1)) * -torch.expm1(-tau)


def importance(weights: Tensor, u: Tensor, pad: float) -> Tensor:
    """Inverse of the cumulative mass of equal bins of [0, 1]."""
    mass = weights + pad
    pdf = mass / mass.sum(-1, True)
    cdf = torch.cumsum(pdf, -1)
    k = torch.searchsorted(cdf, u, right=True).clamp(max=pdf.shape[-1] - 1)
    p = torch.gather(pdf, -1, k)
    return (k + ((u - torch.gather(cdf, -1, k) + p) / p).clamp(0, 1)) / pdf.shape[-1]


class Renderer(nn.Module):
    """Rays through a volume: coarse samples, fine samples where their weights are large, the union composited."""

    def __init__(self, c: Config, fast: bool):
        super().__init__()
        self.c, self.fast, self.field = c, fast, Field(c, fast)

    def forward(self, volume: Tensor, c2w: Tensor, focal: Tensor) -> Tensor:
        """The feature image (batch, features, render, render); in training samples are jittered."""
        c, field = self.c, self.field
        o, d = camera_rays(c2w, focal, c.render)
        near, far = ray_box(o, d)
        view = field.view(d)

        def strata(n: int) -> Tensor:
            jitter = torch.rand(*o.shape[:2], n) if self.training else torch.full((*o.shape[:2], n), 0.5)
            return (torch.arange(n) + jitter) / n

        def seen(t: Tensor) -> tuple[Tensor, Tensor]:
            places = o[:, :, None] + t[..., None] * d[:, :, None]
            return field.samples(lookup(volume, places, self.fast), view)

        coarse = near + (far - near) * strata(c.coarse)
        density, values = seen(coarse)
        with torch.no_grad():
            fine = near + (far - near) * importance(weights_of(density, coarse, far), strata(c.fine), c.pdf_pad)
        more_density, more_values = seen(fine)
        t, order = torch.cat([coarse, fine], -1).sort(stable=True)
        sorted_weights = weights_of(torch.cat([density, more_density], -1).gather(-1, order), t, far)
        w = torch.zeros_like(t).scatter(-1, order, sorted_weights)  # values stay in the order of their sets
        parts = ((w[..., : c.coarse], values), (w[..., c.coarse :], more_values))
        total = sum(torch.matmul(x.unsqueeze(-2), y).squeeze(-2) for x, y in parts)
        image = field.finish(total, w.sum(-1, True), view)
        return image.transpose(1, 2).unflatten(2, (c.render, c.render))
