import numpy as np


class Drive:
    def __init__(self, n, max_speed=1.0, max_turn=6.0, accel=2.0, ang_accel=30.0, gain=6.0):
        self.__dict__.update(locals())
        self.reset()

    def reset(self):
        self.last = np.zeros((self.n, 2))
        self.backward = np.zeros(self.n, bool)

    def __call__(self, command, heading, dt):
        speed = np.linalg.norm(command, axis=-1)
        error = np.arctan2(command[:, 1], command[:, 0]) - heading
        error = (error + np.pi) % (2 * np.pi) - np.pi
        back = np.where(self.backward, np.abs(error) > np.pi / 2 - 0.3, np.abs(error) > np.pi / 2 + 0.3)
        self.backward = np.where(speed > 0.02, back, self.backward)
        error = np.where(self.backward, (error + 2 * np.pi) % (2 * np.pi) - np.pi, error)
        v = speed * np.clip(np.cos(error), 0, 1) * np.where(self.backward, -1, 1)
        w = np.clip(self.gain * error, -self.max_turn, self.max_turn) * np.clip(speed / 0.1, 0, 1)
        want = np.stack([v, w], -1)
        step = np.array([self.accel, self.ang_accel]) * dt
        self.last = self.last + np.clip(want - self.last, -step, step)
        return self.last
