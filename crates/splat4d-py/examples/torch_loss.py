"""A PyTorch loss, added to those of the recipe (pip install torch)."""
import sys

import torch

import splat4d


def huber(image, truth, view):
    """A tenth of Huber's loss: quadratic up to a tenth of full scale, linear beyond."""
    image = torch.from_numpy(image).requires_grad_()
    value = 0.1 * torch.nn.functional.huber_loss(image, torch.from_numpy(truth), delta=0.1)
    value.backward()
    return value.item(), image.grad.numpy()


run = splat4d.train(sys.argv[1], "huber", loss=huber, iterations=50, downscale=4)
print(run, run.iteration, "steps")
