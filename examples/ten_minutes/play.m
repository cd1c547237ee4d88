function torque_nm = play(code, rate_hz, etag, widths_us)
% Play a trial and wait for its end: mean torque above rest in each pulse's period, N·m.
    global playing
    ended = onCleanup(@stop_if_playing);                    % after an error and after Ctrl-C, too
    rest = struct('name', 'rest', 'sequence', 'rest', 'settings', struct('duration_s', 1));
    trial = struct('name', 'trial', 'sequence', 'widths', 'settings', struct('pulse_width_us', widths_us));
    body = jsonencode(struct('participant', code, 'kind', 'sequence', 'pulse_rate_hz', rate_hz, ...
        'segments', {{rest, trial, rest}}));
    for attempt = 1:200                                     % the rig wants a rest between trials
        try
            playing = true;
            test = jsondecode(ask('/v1/tests', body, etag)); break
        catch refused
            playing = isempty(strfind(refused.message, '"status":4'));
            if isempty(strfind(refused.message, 'rest-needed')) || attempt == 200, rethrow(refused); end
            pause(0.3)
        end
    end
    while ~test.done
        pause(0.3)
        test = jsondecode(ask(['/v1/tests/' test.id], '', ''));
    end
    playing = false;
    if ~strcmp(test.state, 'completed'), error('stimrig:ended', '%s', test.reason); end
    samples = textscan(ask(['/v1/recordings/' test.recording_id '/csv'], '', ''), '%f%f%f%*[^\n]', ...
        'Delimiter', ',', 'HeaderLines', 1);
    period = floor((samples{1} - 1) * rate_hz) + 1;
    trial = period >= 1 & period <= numel(widths_us);
    torque_nm = accumarray(period(trial), samples{3}(trial), size(widths_us), @mean) - mean(samples{3}(period < 1));
end

function stop_if_playing()
    global playing
    if ~playing, return, end
    try
        ask('/v1/stop', '{}', '');
    catch
        fprintf(2, 'STOP WAS NOT CONFIRMED: use the emergency switch on the stimulator now\n');
    end
end
