"""The paper's network once more, in PyTorch: what the benchmark times ours against.

As a PyTorch user writes it: dense convolutions, `grid_sample`, nearest upsampling before a convolution.  Volumes are
(batch, features, z, y, x), images (batch, features, row, column); focal = 1 / tan(half the field of view).  float32, no
R1.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spnr_jax.config import EncoderConfig, PaperConfig, TrainConfig

Batch = dict[str, Tensor]  # a view of each object: pos mat c2w focal; target cond mask (batch, features, size, size)
SLOPE = 0.2  # of the leaky ReLUs


def lookup(volume: Tensor, positions: Tensor) -> Tensor:
    """Trilinear lookup (batch, rays, samples, features) inside the box, clamped to the outermost centres."""
    out = F.grid_sample(volume, positions[:, None], padding_mode="border", align_corners=False)
    return out[:, :, 0].permute(0, 2, 3, 1)


class Field(nn.Module):
    """Density softplus(raw - 1), rgb and other features of samples."""

    def __init__(self, c: PaperConfig):
        super().__init__()
        self.freqs = c.direction_frequencies
        self.hidden = nn.Linear(c.encoder.base_width, c.field_width)
        self.density = nn.Linear(c.field_width, 1)
        self.feature = nn.Linear(c.field_width + 3 + 6 * c.direction_frequencies, c.num_features)

    def view(self, d: Tensor) -> Tensor:
        """The part of the features that the direction decides, once a ray."""
        waves = [wave(d * 2**k) for k in range(self.freqs) for wave in (torch.sin, torch.cos)]
        weight = self.feature.weight[:, self.hidden.out_features :]
        return F.linear(torch.cat([d, *waves], -1), weight, self.feature.bias)

    def forward(self, x: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
        """Density, and what is composited: rgb and features."""
        h = F.softplus(self.hidden(x))
        out = F.linear(h, self.feature.weight[:, : self.hidden.out_features]) + view[:, :, None]
        density = F.softplus(self.density(h)[..., 0] - 1)
        return density, torch.cat([torch.sigmoid(out[..., :3]), out[..., 3:]], -1)


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

    def __init__(self, c: PaperConfig):
        super().__init__()
        self.c, self.field = c, Field(c)

    def forward(self, volume: Tensor, c2w: Tensor, focal: Tensor) -> Tensor:
        """The feature image (batch, features, render, render); in training samples are jittered."""
        c, field = self.c, self.field
        o, d = camera_rays(c2w, focal, c.render_resolution)
        near, far = ray_box(o, d)
        view = field.view(d)

        def strata(n: int) -> Tensor:
            jitter = torch.rand(*o.shape[:2], n) if self.training else torch.full((*o.shape[:2], n), 0.5)
            return (torch.arange(n) + jitter) / n

        def seen(t: Tensor) -> tuple[Tensor, Tensor]:
            places = o[:, :, None] + t[..., None] * d[:, :, None]
            return field(lookup(volume, places), view)

        coarse = near + (far - near) * strata(c.sampling.num_coarse)
        density, values = seen(coarse)
        with torch.no_grad():
            fine = near + (far - near) * importance(
                weights_of(density, coarse, far), strata(c.sampling.num_fine), c.sampling.padding
            )
        more_density, more_values = seen(fine)
        t, order = torch.cat([coarse, fine], -1).sort(stable=True)
        sorted_weights = weights_of(torch.cat([density, more_density], -1).gather(-1, order), t, far)
        w = torch.zeros_like(t).scatter(-1, order, sorted_weights)  # values stay in the order of their sets
        parts = ((w[..., : c.sampling.num_coarse], values), (w[..., c.sampling.num_coarse :], more_values))
        total = sum(torch.matmul(x.unsqueeze(-2), y).squeeze(-2) for x, y in parts)
        image = torch.cat([total[..., :3] + 1 - w.sum(-1, True), total[..., 3:]], -1)  # on white
        return image.transpose(1, 2).unflatten(2, (c.render_resolution, c.render_resolution))


class PointNet(nn.Module):
    """Points (p, 11) to features."""

    def __init__(self, c: EncoderConfig):
        super().__init__()
        widths = (11, *c.point_widths)
        self.linears = nn.ModuleList(nn.Linear(a, b, bias=False) for a, b in zip(widths, widths[1:], strict=False))
        self.norms = nn.ModuleList(nn.BatchNorm1d(w) for w in c.point_widths)
        self.out = nn.Linear(widths[-1], c.point_features)

    def forward(self, x: Tensor) -> Tensor:
        """Linear, batch norm, ReLU, three times; linear."""
        for linear, norm in zip(self.linears, self.norms, strict=True):
            x = F.relu(norm(linear(x)))
        return self.out(x)


class Block(nn.Module):
    """Convolution of 3^3 taps, group norm, ReLU."""

    def __init__(self, inputs: int, outputs: int, c: EncoderConfig, kind: str):
        super().__init__()
        self.conv = nn.Conv3d(inputs, outputs, 3, 2 if kind == "down" else 1, 1, bias=False)
        self.norm, self.up = nn.GroupNorm(c.num_groups, outputs), kind == "up"

    def forward(self, x: Tensor) -> Tensor:
        """Nearest x2 before the convolution where it goes up."""
        return F.relu(self.norm(self.conv(F.interpolate(x, scale_factor=2) if self.up else x)))


class UNet(nn.Module):
    """The 3D U-Net; skip connections are sums."""

    def __init__(self, c: EncoderConfig):
        super().__init__()
        widths = [c.base_width * 2**i for i in range(c.num_stages + 1)]
        pairs = list(zip(widths, widths[1:], strict=False))
        self.stem = Block(c.point_features + 1, c.base_width, c, "same")
        self.down = nn.ModuleList(Block(a, b, c, "down") for a, b in pairs)
        self.same = nn.ModuleList(Block(b, b, c, "same") for _, b in pairs)
        self.up = nn.ModuleList(Block(b, a, c, "up") for a, b in reversed(pairs))

    def forward(self, x: Tensor) -> Tensor:
        """(batch, features, z, y, x)."""
        x = self.stem(x)
        skips = []
        for down, same in zip(self.down, self.same, strict=True):
            skips.append(x)
            x = same(down(x))
        for up in self.up:
            x = up(x) + skips.pop()
        return x


class Upsampler(nn.Module):
    """The feature image to a picture of twice the size."""

    def __init__(self, c: PaperConfig):
        super().__init__()
        width = c.upsampler_width
        self.conv0 = nn.Conv2d(c.num_features, width, 3, 1, 1)
        self.conv1 = nn.Conv2d(width, width, 3, 1, 1)
        self.conv2 = nn.Conv2d(width, 32, 3, 1, 1)  # after nearest x2
        self.conv3 = nn.Conv2d(32, 3, 3, 1, 1)

    def forward(self, x: Tensor) -> Tensor:
        """What the convolutions add to the enlarged rgb."""
        y = F.leaky_relu(self.conv1(F.leaky_relu(self.conv0(x), SLOPE)), SLOPE)
        y = self.conv2(F.interpolate(y, scale_factor=2))
        rgb = F.interpolate(x[:, :3], scale_factor=2, mode="bilinear", align_corners=False)
        return self.conv3(F.leaky_relu(y, SLOPE)) + rgb


class Generator(nn.Module):
    """Points and materials to a volume, a volume and a camera to a picture."""

    def __init__(self, c: PaperConfig):
        super().__init__()
        self.c, self.points, self.unet = c, PointNet(c.encoder), UNet(c.encoder)
        self.renderer, self.upsampler = Renderer(c), Upsampler(c)

    def encode_volume(self, pos: Tensor, mat: Tensor) -> Tensor:
        """The volume of points (batch, n, 3) with materials (batch, n, 5)."""
        batch, n = len(pos), self.c.encoder.volume_resolution
        grid = (pos + 1) * (0.5 * n)
        cell = grid.floor().clamp(0, n - 1)
        features = self.points(torch.cat([pos, grid - cell - 0.5, mat], -1).flatten(0, 1))
        cell = cell.long()
        x, y, z = cell.unbind(-1)
        index = (((torch.arange(batch)[:, None] * n + z) * n + y) * n + x).view(-1)
        inside = (pos.abs() <= 1).all(-1).to(pos.dtype).view(-1)
        count = pos.new_zeros(batch * n**3).index_add_(0, index, inside)
        share = (inside / count[index].clamp_min(1))[:, None]
        rows = torch.cat([features, torch.ones_like(share)], 1) * share  # add up to [mean, occupancy] in a voxel
        volume = rows.new_zeros(batch * n**3, rows.shape[1]).index_add(0, index, rows)
        return self.unet(volume.view(batch, n, n, n, -1).permute(0, 4, 1, 2, 3))

    def render_volume(self, volume: Tensor, c2w: Tensor, focal: Tensor) -> tuple[Tensor, Tensor]:
        """(picture, rgb at the resolution of the rays) of one view of each volume."""
        features = self.renderer(volume, c2w, focal)
        return self.upsampler(features), features[:, :3]

    def forward(self, pos: Tensor, mat: Tensor, c2w: Tensor, focal: Tensor) -> tuple[Tensor, Tensor]:
        """Both."""
        return self.render_volume(self.encode_volume(pos, mat), c2w, focal)


class Discriminator(nn.Module):
    """PatchGAN on picture, condition and mask."""

    def __init__(self, w: int, groups: int):
        super().__init__()
        widths = (7, w, 2 * w, 4 * w, 8 * w, 1)
        normed = (False, True, True, True, False)
        self.convs = nn.ModuleList(
            nn.Conv2d(widths[i], widths[i + 1], 4, 2 if i < 3 else 1, 1, bias=not normed[i]) for i in range(5)
        )
        self.norms = nn.ModuleList(
            nn.GroupNorm(groups, widths[i + 1]) if normed[i] else nn.Identity() for i in range(4)
        )
        self.to(memory_format=torch.channels_last)

    def forward(self, image: Tensor, cond: Tensor, mask: Tensor) -> Tensor:
        """Logits of patches."""
        x = torch.cat([image, cond, mask], 1).contiguous(memory_format=torch.channels_last)
        for conv, norm in zip(self.convs, self.norms, strict=False):
            x = F.leaky_relu(norm(conv(x)), SLOPE)
        return self.convs[-1](x)


def compile_generator(generator: Generator) -> Generator:
    """The generator with torch.compile on all but the U-Net: on a CPU oneDNN's convolutions beat generated code."""
    for module in (generator.points, generator.renderer, generator.upsampler):
        module.compile(dynamic=False)
    return generator


def paper_config(c: TrainConfig) -> PaperConfig:
    """The sizes of the network."""
    assert isinstance(c.model, PaperConfig)
    return c.model


def trainer(c: TrainConfig, compile: bool, adversarial: bool) -> Callable[[Batch], None]:
    """A training step: one forward of the generator, an update of the discriminator, an update of the generator."""
    model, groups = paper_config(c), paper_config(c).encoder.num_groups
    generator, judge = Generator(model).train(), Discriminator(c.loss.discriminator_width, groups).train()
    generator = compile_generator(generator) if compile else generator
    draw = torch.compile(judge, dynamic=False) if compile else judge
    betas = (0.5, 0.999)
    adam_g = torch.optim.Adam(generator.parameters(), c.optimizer.lr_generator, betas, fused=True)
    adam_d = torch.optim.Adam(judge.parameters(), c.optimizer.lr_discriminator, betas, fused=True)

    def step(batch: Batch) -> None:
        image, rgb = generator(batch["pos"], batch["mat"], batch["c2w"], batch["focal"])
        low = F.avg_pool2d(batch["target"], batch["target"].shape[-1] // model.render_resolution)
        loss = c.loss.l1_weight * (
            F.l1_loss(image, batch["target"]) + c.loss.low_resolution_weight * F.l1_loss(rgb, low)
        )
        if adversarial:
            adam_d.zero_grad()
            both = torch.cat([batch["target"], image.detach()])
            real, fake = draw(both, torch.cat([batch["cond"]] * 2), torch.cat([batch["mask"]] * 2)).chunk(2)
            (F.softplus(-real).mean() + F.softplus(fake).mean()).backward()
            adam_d.step()
            judge.requires_grad_(False)
            loss = loss + c.loss.adversarial_weight * F.softplus(-draw(image, batch["cond"], batch["mask"])).mean()
        adam_g.zero_grad()
        loss.backward()
        adam_g.step()
        judge.requires_grad_(True)

    return step


def function(c: TrainConfig, batch: Batch, mode: str, compile: bool) -> Callable[[], object]:
    """One step, one encoding of the batch, or one view of each of its volumes."""
    torch.manual_seed(0)
    if mode.startswith("train"):
        step = trainer(c, compile, adversarial=mode == "train")
        return lambda: step(batch)
    generator = Generator(paper_config(c)).eval()
    guard = torch.inference_mode
    if compile:
        generator, guard = compile_generator(generator), torch.no_grad
    encode = guard()(lambda: generator.encode_volume(batch["pos"], batch["mat"]))
    volume = encode()
    draw = guard()(lambda: generator.render_volume(volume, batch["c2w"], batch["focal"]))
    return encode if mode == "encode" else draw
