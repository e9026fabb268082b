"""A neural distance field to a mesh: few evaluations, vertices where the network is 0.

    pip install torch && python examples/tools/neural_field.py [OUT.ply]

A small network learns the distances of a ring for half a minute. ``reconstruct`` then evaluates the
network at coarse samples and at vertices, instead of at every node of a fine lattice.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter

import torch

from super_sdf import DistanceFunction, reconstruct, write_mesh

options = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
options.add_argument("out", nargs="?", default="ring.ply", help="mesh file")
out = options.parse_args().out


def ring(points):
    """Return the distances of points, (n, 3), to a ring."""
    return torch.hypot(points[:, :2].norm(dim=1) - 0.55, points[:, 2]) - 0.22


torch.manual_seed(0)
layers = [torch.nn.Linear(3, 64), torch.nn.Softplus(100), torch.nn.Linear(64, 64)]
model = torch.nn.Sequential(*layers, torch.nn.Softplus(100), torch.nn.Linear(64, 1))
optimiser = torch.optim.Adam(model.parameters(), 3e-3)
schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 600)
for _ in range(600):
    points = 2 * torch.rand(2048, 3) - 1
    loss = (model(points)[:, 0] - ring(points)).abs().mean()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    schedule.step()

field = DistanceFunction(model)
mesh = reconstruct(function=field, bounds=(-1, 1), spacing=2 / 31)
write_mesh(mesh, out, force=True)

dense = (4 * 31 + 1) ** 3
off = model(torch.as_tensor(mesh.vertices)).abs().mean().item() / (2 / 31)
print(f"{len(mesh.faces):,} triangles, closed: {mesh.is_closed()}")
print(f"{field.evaluations:,} evaluations instead of {dense:,}; {off:.5f} voxels off in the mean")
